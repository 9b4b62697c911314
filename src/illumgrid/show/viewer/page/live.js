// Light before it is complete: requests new light, with what the page shows, and writes it to the textures.

import { eyeOf, facing } from "./camera.js";

const PAUSE = 300; // milliseconds from an answer to the next request

function asked(scene, state, since, aspect) {
  const slope = scene.tangent * Math.max(1, aspect), { forward } = facing(state.view, scene.axes);
  return `since=${since}&sweep=${state.sweep}&eye=${eyeOf(state.view, scene.axes)}&forward=${forward}&slope=${slope}`;
}

// Writes half floats to a part of a texture of light.
function lay(gl, texture, channels, from, shape, texels) {
  gl.bindTexture(gl.TEXTURE_3D, texture);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texSubImage3D(gl.TEXTURE_3D, 0, ...from, ...shape, channels === 1 ? gl.RG : gl.RGBA, gl.HALF_FLOAT, texels);
}

// Writes an answer to the textures; returns its header.
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

// Gets an answer from the server of the page.
async function fetched(question) {
  const answer = await fetch(`light?${question}`);
  if (!answer.ok) throw new Error(answer.status);
  return answer.arrayBuffer();
}

// Requests light until it is complete; `say` shows the progress, `renew` draws new light, `get` gets the answer to a request.
export function live(picture, scene, state, aspect, say, renew, get = fetched) {
  let since = scene.live;
  const ask = async () => {
    const head = taken(picture, scene, await get(asked(scene, state, since, aspect())));
    since = head.stamp;
    if (head.parts.length) renew();
    say(head.done ? `The light is complete. ${get === fetched ? "Reload the page" : "Show it again"} for its error bars.` : `${Math.floor(100 * head.share)} % of the light is computed.`);
    if (!head.done) setTimeout(again, PAUSE);
  };
  const again = () => ask().catch(() => say("The command that computes the light has ended; start it again to go on."));
  again();
}
