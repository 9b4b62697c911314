"""The page in a notebook, by anywidget: Jupyter, VS Code, Colab."""

from functools import cache
from typing import Any

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.light import Illumination
from illumgrid.show.viewer import compressed, script, shaders, source


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
        """A view of a lit scene; `isovalue`, of the first field, follows the slider and sets it."""

        _esm = script("widget")
        isovalue = traitlets.Float().tag(sync=True)
        range = traitlets.Tuple(traitlets.Float(), traitlets.Float(), read_only=True)
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

    return View


def widget(light: Illumination, isovalue: float | None = None, height: int = 520) -> Any:
    """A widget that shows `light`; see `Illumination.show`."""
    import json

    view = _widget_class()
    from illumgrid.show.viewer.packing import packed

    scene, data = packed(light)
    low, high = map(float, light.scene.fields[0].range)
    made = view(
        height=height,
        _scene=json.dumps(scene, allow_nan=False),
        _shaders=json.dumps(shaders()),
        _style=source("view.css"),
        _markup=source("view.html"),
        _data=compressed(data),
    )
    made.set_trait("range", (low, high))
    made.isovalue = (low + high) / 2 if isovalue is None else isovalue
    return made
