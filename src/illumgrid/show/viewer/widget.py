"""The page in a notebook, by anywidget: Jupyter, VS Code, Colab."""

import json
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.light import Illumination
from illumgrid.show.tints import Tint
from illumgrid.show.viewer import compressed, script, shaders, source
from illumgrid.show.viewer.texture import Coming


@cache
def _widget_class() -> type[Any]:
    try:
        import anywidget
        import traitlets
    except ImportError as reason:
        raise BadInput(
            "a view in the notebook needs the package anywidget, which is missing; "
            "install illumgrid[notebook], or write a page with 'illumgrid view DIR --export page.html'"
        ) from reason

    class View(anywidget.AnyWidget):  # type: ignore[misc, unused-ignore]
        """A lit scene; the traits `isovalue` (of the first field) and `weights` (by light) follow the sliders."""

        _esm = script("widget", live=True)
        isovalue = traitlets.Float().tag(sync=True)
        range = traitlets.Tuple(traitlets.Float(), traitlets.Float(), read_only=True)
        lights = traitlets.Tuple(read_only=True)
        weights = traitlets.Dict(value_trait=traitlets.Float()).tag(sync=True)
        height = traitlets.Int(520).tag(sync=True)
        _scene = traitlets.Unicode().tag(sync=True)
        _shaders = traitlets.Unicode().tag(sync=True)
        _style = traitlets.Unicode().tag(sync=True)
        _markup = traitlets.Unicode().tag(sync=True)
        _data = traitlets.Bytes().tag(sync=True)

        @traitlets.validate("isovalue")
        def _within_range(self, proposal: Any) -> float:
            if not np.isfinite(proposal["value"]):
                raise traitlets.TraitError(f"the isovalue is {proposal['value']}; expected a finite number")
            return float(np.clip(proposal["value"], *self.range))

        @traitlets.validate("weights")
        def _of_known_lights(self, proposal: Any) -> dict[str, float]:
            for name, weight in proposal["value"].items():
                if name not in self.lights or not np.isfinite(weight):
                    known = ", ".join(self.lights) or "none, for this run keeps no lights apart"
                    raise traitlets.TraitError(f"light {name!r} weighs {weight}; expected a finite number for {known}")
            return {**self.weights, **proposal["value"]}

    return View


def widget(
    light: Illumination,
    coming: Coming | None = None,
    news: Callable[[str], bytes] | None = None,
    *,
    isovalue: float | None = None,
    height: int = 520,
    up: str | None = None,
    tint: Tint | None = None,
) -> Any:
    """A widget that shows `light`; see `Illumination.show`.

    If light is still `coming`, its views request it by messages, which `news` answers like requests of a page.
    """
    view = _widget_class()
    from illumgrid.show.viewer.packing import kept_apart

    described = _described(light, up, tint, coming)
    made = view(
        height=height,
        _shaders=json.dumps(shaders()),
        _style=source("view.css"),
        _markup=source("view.html"),
        **described,
    )
    lead = next((field for field in light.scene.fields if field.isovalue is None), light.scene.fields[0])
    low, high = map(float, lead.range)
    made.set_trait("range", (low, high))
    made.set_trait("lights", tuple(kept_apart(light)))
    made.weights = kept_apart(light)
    made.isovalue = (low + high) / 2 if isovalue is None else isovalue
    if news:
        made.on_msg(partial(_answer, news))
    return made


def follow(made: Any, light: Illumination, up: str | None = None) -> None:
    """Use the complete light for views that are opened from now on; open ones have requested it."""
    from illumgrid.show.viewer.packing import kept_apart

    with made.hold_sync():
        for name, value in _described(light, up, None, None).items():
            setattr(made, name, value)
        made.set_trait("lights", tuple(kept_apart(light)))
        made.weights = kept_apart(light)


def _described(light: Illumination, up: str | None, tint: Tint | None, coming: Coming | None) -> dict[str, Any]:
    from illumgrid.show.viewer.packing import packed

    scene, data = packed(light, up, tint, coming)
    return {"_scene": json.dumps(scene, allow_nan=False), "_data": compressed(data, 1 if coming else 6)}


def _answer(news: Callable[[str], bytes], made: Any, asked: Any, buffers: Any) -> None:
    """Send new light to the view that asks; without a buffer if the light is gone."""
    try:
        found = [news(str(asked["question"]))]
    except Exception as problem:
        made.send({"number": asked["number"], "problem": str(problem)})
        return
    made.send({"number": asked["number"]}, buffers=found)
