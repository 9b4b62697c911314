// Light that is still to come: what is new is asked for, with what the page shows, and goes into the textures.

import { eyeOf, facing } from "./camera.js";

const PAUSE = 300; // milliseconds from an answer to the next question

function asked(scene, state, since, aspect) {
  const slope = scene.tangent * Math.max(1, aspect), { forward } = facing(state.view, scene.axes);
  return `since=${since}&sweep=${state.sweep}&eye=${eyeOf(state.view, scene.axes)}&forward=${forward}&slope=${slope}`;
}

// Half floats into a part of a texture of light.
function lay(gl, texture, channels, from, shape, texels) {
  gl.bindTexture(gl.TEXTURE_3D, texture);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texSubImage3D(gl.TEXTURE_3D, 0, ...from, ...shape, channels === 1 ? gl.RG : gl.RGBA, gl.HALF_FLOAT, texels);
}

// Puts an answer into the textures; returns its header.
export function taken(picture, scene, buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let at = 4 + length;
  for (const { texture, from, shape } of head.parts) {
    const field = texture < scene.fields.length, about = field ? scene.fields[texture].light : scene.atlas;
    const count = shape[0] * shape[1] * shape[2] * (about.channels + 1);
    lay(picture.gl, field ? picture.fields[texture].light : picture.walls, about.channels, from, shape, new Uint16Array(buffer, at, count));
    at += 2 * count;
  }
  return head;
}

// From the server of the page.
async function fetched(question) {
  const answer = await fetch(`light?${question}`);
  if (!answer.ok) throw new Error(answer.status);
  return answer.arrayBuffer();
}

// Asks until all light is there; `say` shows how far it is, `renew` draws what is new, `get` has the answer to a question.
export function live(picture, scene, state, aspect, say, renew, get = fetched) {
  let since = scene.live;
  const ask = async () => {
    const head = taken(picture, scene, await get(asked(scene, state, since, aspect())));
    since = head.stamp;
    if (head.parts.length) renew();
    say(head.done ? `All light is there. ${get === fetched ? "Reload the page" : "Show it again"} for its error bars.` : `${Math.floor(100 * head.share)} % of the light is there.`);
    if (!head.done) setTimeout(again, PAUSE);
  };
  const again = () => ask().catch(() => say("The command that computes the light has ended; start it again to go on."));
  again();
}
