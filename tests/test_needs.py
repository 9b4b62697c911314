"""What a command is going to need is said before it takes any of it."""

import re

import pytest

import illumgrid as ig
from illumgrid.errors import BadInput
from illumgrid.field.lattice import specs_over
from illumgrid.field.scene import Scene, level_table
from illumgrid.io import exports, needs
from shapes import ball, lit, sky


@pytest.fixture
def free(monkeypatch):
    """Says how many bytes are free."""
    return lambda count: monkeypatch.setattr(needs, "free_memory", lambda: int(count))


def test_a_grid_beyond_memory_is_refused_with_one_that_fits(call, free):
    free(4e9)
    last = call("run", "v.npy", "--grid", "60000", code=2).splitlines()[-1]
    assert last.startswith("illumgrid: the run needs ") and "of memory, 4 GB are free; --grid " in last
    scene = Scene.sky(ball(10))
    levels = level_table(scene, 2)
    with pytest.raises(BadInput) as reason:
        needs.check_run(scene, specs_over(scene, 60000), levels)
    said = re.search(r"grid=(\d+) would need ([\d.]+) GB", str(reason.value))
    assert float(said[2]) < 4
    needs.check_run(scene, specs_over(scene, int(said[1])), levels)  # what is proposed is accepted
    free(float(said[2]) * 0.5e9)
    with pytest.raises(BadInput):
        needs.check_run(scene, specs_over(scene, int(said[1])), levels)


def test_nodes_that_no_isosurface_of_the_range_meets_take_little():
    scene = Scene.sky(ball(20), range=(0.5, 0.52))
    wide = Scene.sky(ball(20), range=(0.05, 0.95))
    assert needs._share(scene.fields[0]) < 0.2 * needs._share(wide.fields[0])


def test_the_library_info_and_export_refuse_as_well(refuse, tmp_path, free):
    light = lit(sky())
    free(1000)
    with pytest.raises(BadInput, match=r"the run needs .* cut or downsample the volume"):
        ig.run(Scene.sky(ball(10)), paths=1)
    with pytest.raises(BadInput, match=r"the file needs .* leave out --on field"):
        exports.write(light, tmp_path / "a.vti", on="field")
    assert not (tmp_path / "a.vti").exists()
    refuse("info", "v.npy", words=["info needs", "--downsample"])
