"""The view in a notebook: executed by a kernel, and the widget's script driven by a model in a browser."""

import base64
import builtins
import gzip
import json
import threading
from dataclasses import replace

import numpy as np
import pytest

import illumgrid as ig
from browser import browser, coloured, pair, until, with_separate_lights  # noqa: F401
from illumgrid.field.lights import Distant
from illumgrid.live import Live
from illumgrid.notebook import show
from illumgrid.show.viewer.widget import _widget_class
from shapes import lit, refused, sky

pytestmark = pytest.mark.filterwarnings("default")  # of Jupyter's packages

CELLS = [
    """
import sys
sys.path.insert(0, "TESTS")
from browser import coloured, pair
light = coloured(pair())
light
""",
    "view = light.show(isovalue=2400)\nview",
    "view.isovalue = 2700\nseen = []\nview.observe(lambda change: seen.append(change.new), 'isovalue')",
    "view.isovalue = 1e9\nprint(seen, view.range)",
    "from illumgrid.notebook import show\njob = show(light.scene, grid=9, paths=2)\njob",
    "print(job.wait().grids[0].spec.shape)",
]


def test_a_notebook_shows_a_picture_and_a_view_whose_isovalue_can_be_set(request):
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("anywidget")
    cells = [nbformat.v4.new_code_cell(c.replace("TESTS", str(request.path.parent)).strip()) for c in CELLS]
    book = nbformat.v4.new_notebook(cells=cells)
    nbclient.NotebookClient(book, timeout=300, kernel_name="python3").execute()
    picture = base64.b64decode(book.cells[0].outputs[0].data["image/png"])
    assert picture.startswith(b"\x89PNG")
    view = book.cells[1].outputs[0].data["application/vnd.jupyter.widget-view+json"]
    states = book.metadata.widgets["application/vnd.jupyter.widget-state+json"]["state"]
    state = states[view["model_id"]]["state"]
    assert state["isovalue"] == 3000.0  # kept within the range
    assert state["_anywidget_id"].endswith("View") and "WebGL2" in state["_esm"]
    assert "application/vnd.jupyter.widget-view+json" in book.cells[4].outputs[0].data
    assert book.cells[5].outputs[0].text == "(9, 9, 9)\n"
    assert book.cells[3].outputs[0].text == "[3000.0] (2100.0, 3000.0)\n"


def shown(browser, view, ask=None):  # noqa: F811
    """A page that shows the view, led by a model that stands for a notebook's; and a list of what goes wrong in it.

    What it sends, `ask` answers.
    """
    names = ("isovalue", "weights", "height", "_scene", "_shaders", "_style", "_markup")
    traits = {name: getattr(view, name) for name in names}
    page = browser.context.new_page()
    troubles = []
    page.on("pageerror", lambda error: troubles.append(str(error)))
    if ask:
        page.expose_function("ask", ask)
    page.set_content("<div id=here style='width: 160px'></div>")
    lead = """async ([script, traits, data]) => {
        const view = (text) => new DataView(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
        const handlers = {};
        traits._data = view(data);
        globalThis.model = { get: (k) => traits[k], set: (k, v) => { traits[k] = v },
            save_changes: () => { model.saved = traits.isovalue },
            on: (k, f) => { handlers[k] = f }, off: () => {},
            send: async ({ number, question }) => { for (const [said, held] of await ask(number, question))
                handlers['msg:custom'](said, held.map(view)) },
            lead: (v, k = 'isovalue') => { traits[k] = v; handlers[`change:${k}`]() } };
        const module = await import(URL.createObjectURL(new Blob([script], { type: 'text/javascript' })));
        const here = document.getElementById('here');
        await module.default.render({ model, el: here });
        here.firstChild.shadowRoot.querySelector('[data-part="rest"]').click();  // rays would take the processor's time
    }"""
    page.evaluate(lead, [view._esm, traits | {"height": 140}, base64.b64encode(view._data).decode()])
    return page, troubles


@pytest.fixture
def gate(monkeypatch):
    """More than coarse light comes when it is set."""
    opened, choose = threading.Event(), Live.next
    monkeypatch.setattr(
        Live, "next", lambda live, *what: (live.coarse.is_set() and opened.wait(60), choose(live, *what))[1]
    )
    yield opened
    opened.set()


def test_a_view_is_coarse_at_once_and_asks_for_the_rest_as_it_comes(browser, gate):  # noqa: F811
    pytest.importorskip("anywidget")
    scene, few = sky(), {"grid": 21, "paths": 4, "isovalues": 6}
    job = show(scene, **few, height=140)
    assert job.light is None and json.loads(job.view._scene)["live"] > 0
    asked = []

    def ask(number, question):
        """What a kernel does with a message of a view."""
        said = []
        job.view.send = lambda content, buffers=(): said.append(
            (content, [base64.b64encode(b).decode() for b in buffers])
        )
        job.view._handle_custom_msg({"number": number, "question": question}, [])
        asked.append(question)
        return said

    page, troubles = shown(browser, job.view, ask)
    subtitle = "document.querySelector('#here > div').shadowRoot.querySelector('[data-part=subtitle]').textContent"
    until(page, f"{subtitle}.includes(' of the light is computed')")
    gate.set()
    light = job.wait()
    until(page, f"{subtitle}.startsWith('The light is complete. Show it again')")
    assert not troubles and "since=" in asked[0] and "sweep=0.5" in asked[0]
    page.close()
    whole = ig.run(scene, **few, judge=False)
    assert np.array_equal(light.grids[0].light, whole.grids[0].light)
    assert json.loads(job.view._scene)["live"] == 0 and gzip.decompress(job.view._data) == gzip.decompress(
        whole.show(height=140)._data
    )


def test_light_in_a_notebook_can_be_stopped_and_what_goes_wrong_is_said(gate):
    pytest.importorskip("anywidget")
    job = show(sky(), grid=21, paths=4)
    threading.Timer(0.5, gate.set).start()
    job.stop()
    with pytest.raises(Exception, match="stopped before all light"):
        job.wait()
    said = []
    job.view.send = lambda content, buffers=(): said.append((content["number"], len(buffers)))
    job.view._handle_custom_msg({"number": 7, "question": "since=0"}, [])
    job._problem = MemoryError("none is left")
    job.view._handle_custom_msg({"number": 8, "question": "since=0"}, [])
    assert said == [(7, 1), (8, 0)]
    refused(lambda: show(sky(), grid=1), "grid", "at least 2")
    refused(lambda: show(sky(), paths=0), "paths", "0")


def test_the_view_follows_the_model_and_leads_it(browser):  # noqa: F811
    pytest.importorskip("anywidget")
    page, troubles = shown(browser, coloured(pair()).show(isovalue=2400))
    slider = page.locator('input[type="range"]').first
    assert float(slider.input_value()) == pytest.approx(2400)
    page.evaluate("model.lead(2850)")
    assert float(slider.input_value()) == pytest.approx(2850)
    slider.evaluate("e => { e.value = 2500; e.dispatchEvent(new Event('input', { bubbles: true })) }")
    assert page.evaluate("model.saved") == pytest.approx(2500)
    assert "isovalue" not in page.url and not troubles
    page.close()


def test_weights_of_lights_lead_the_view_and_follow_it(browser):  # noqa: F811
    traitlets = pytest.importorskip("traitlets")
    pytest.importorskip("anywidget")
    scene = replace(pair(), lights=(Distant("key", (-1, -1, 1), 25, (3, 2, 1)),))
    view = with_separate_lights(scene).show(isovalue=2400)
    lamp, key = sorted(view.weights, key="key".__eq__)
    assert view.weights == {lamp: 1.0, "key": 1.0} and key == "key"
    view.weights = {"key": 2.0}  # the other keeps its weight
    assert view.weights == {lamp: 1.0, "key": 2.0}
    for wrong in ({"kye": 1.0}, {"key": np.inf}):
        with pytest.raises(traitlets.TraitError, match=r"expected a finite number for .*key"):
            view.weights = wrong
    page, troubles = shown(browser, view)
    sliders = page.locator('[data-part="lights"] input')
    numbers = [float(s.input_value()) for s in sliders.all()]
    assert numbers == [view.weights[name] for name in view.lights] and 2.0 in numbers
    assert float(page.locator('input[type="range"]').first.input_value()) == pytest.approx(2400)
    page.evaluate("w => model.lead(w, 'weights')", {lamp: 0.5, "key": 1.5})
    assert sorted(float(s.input_value()) for s in sliders.all()) == [0.5, 1.5]
    at = view.lights.index("key")
    sliders.nth(at).evaluate("e => { e.value = 0.25; e.dispatchEvent(new Event('input', { bubbles: true })) }")
    assert page.evaluate("model.get('weights')") == {lamp: 0.5, "key": 0.25} and not troubles
    page.close()


def test_traits_refuse_what_is_not_a_number_and_keep_to_the_range():
    traitlets = pytest.importorskip("traitlets")
    pytest.importorskip("anywidget")
    view = lit(sky()).show(height=300)
    assert view.isovalue == pytest.approx(0.6) and view.height == 300
    view.isovalue = -1
    assert view.isovalue == 0.3
    with pytest.raises(traitlets.TraitError, match="finite"):
        view.isovalue = np.nan


def test_without_anywidget_a_sentence_says_what_to_install(monkeypatch):
    kept = builtins.__import__

    def without(name, *rest):
        if name == "anywidget":
            raise ImportError(name)
        return kept(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    _widget_class.cache_clear()
    refused(lambda: lit(sky()).show(), "anywidget", "illumgrid[notebook]")
    _widget_class.cache_clear()


def test_the_repr_is_a_still_picture():
    assert lit(sky())._repr_png_().startswith(b"\x89PNG")
