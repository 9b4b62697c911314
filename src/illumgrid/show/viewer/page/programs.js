// Compiles shaders and sets their uniforms.

export function program(gl, vertex, fragment) {
  const built = gl.createProgram();
  const head = "#version 300 es\nprecision highp float;\nprecision highp int;\nprecision highp sampler3D;\nprecision highp usampler3D;\n";
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, head + text);
    gl.compileShader(shader);
    gl.attachShader(built, shader);
  }
  gl.linkProgram(built);
  if (!gl.getProgramParameter(built, gl.LINK_STATUS) && !gl.isContextLost()) {
    const logs = gl.getAttachedShaders(built).map((s) => gl.getShaderInfoLog(s));
    throw new Error(`The graphics driver refused the page's shaders: ${logs.join(" ")} ${gl.getProgramInfoLog(built)}`);
  }
  const at = {};
  for (let k = 0; k < gl.getProgramParameter(built, gl.ACTIVE_UNIFORMS); k++) {
    const { name, type } = gl.getActiveUniform(built, k);
    at[name] = { place: gl.getUniformLocation(built, name), type };
  }
  return { built, at };
}

export function set(gl, { at }, values) {
  const how = {
    [gl.FLOAT]: (p, v) => (v.length ? gl.uniform1fv(p, v) : gl.uniform1f(p, v)),
    [gl.FLOAT_VEC2]: (p, v) => gl.uniform2fv(p, v),
    [gl.FLOAT_VEC3]: (p, v) => gl.uniform3fv(p, v),
    [gl.FLOAT_VEC4]: (p, v) => gl.uniform4fv(p, v),
    [gl.FLOAT_MAT4]: (p, v) => gl.uniformMatrix4fv(p, false, v),
  };
  for (const [name, value] of Object.entries(values)) {
    if (at[name]) (how[at[name].type] ?? ((p, v) => (v.length ? gl.uniform1iv(p, v) : gl.uniform1i(p, v))))(at[name].place, value);
  }
}
