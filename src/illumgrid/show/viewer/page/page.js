// A standalone page: unpack its data and start the view.

import { unpack } from "./numbers.js";
import { complain, view } from "./view.js";

const held = (id) => document.getElementById(id).textContent;

unpack(held("data"))
  .then((data) => {
    globalThis.illumgrid = view(document, JSON.parse(held("scene")), data, JSON.parse(held("shaders")));
  })
  .catch((error) => complain(document, error.message));
