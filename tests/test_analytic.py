"""Closed forms: every backend agrees with them, and a slightly wrong one does not."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from illumgrid import cli, registry
from illumgrid.accuracy import verify
from illumgrid.accuracy.verify import check, contenders
from illumgrid.backends.numba_ import Numba
from illumgrid.errors import BadInput
from illumgrid.field.scene import Material, Quad
from illumgrid.field.volume import interpolate, world_to_index
from illumgrid.transport import analytic
from illumgrid.transport.agreement import judge, line, sidak
from illumgrid.transport.samples import Queries, Samples


@pytest.fixture(scope="module")
def cases():
    return [make() for make in analytic.CASES]


# Only here noise limits what is found. Elsewhere 2^17 paths find the same bias as 2^20: the bound of discretisation is
# larger, no path is off by more than rounding, or the cells of the box limit both (1.16 and 1.00 %, 1.45 and 1.26).
# White furnaces find 0.08 % in place of 0.02, but test_theory asks each of their paths.
NOISY = (
    "within a film", "sealed furnace, glowing walls", "rectangular lamp", "floor beside a ball", "discs of the sky",
)  # fmt: skip


@pytest.mark.parametrize("name", contenders())
def test_a_backend_agrees_with_every_closed_form(name, cases):
    most = 17 if name in ("embree", "reference") else 20
    noisy = [case for case in cases if case.name in NOISY]
    quiet = [case for case in cases if case.name not in NOISY]
    assert len(noisy) == len(NOISY)
    rows = list(check(contenders([name]), paths=1 << 17, seed=1, cases=quiet))
    rows += check(contenders([name]), paths=1 << most, seed=1, cases=noisy)
    assert len(rows) == sum(not case.voxels or name in ("numba:levelset", "reference") for case in cases)
    assert all(row.agrees for row in rows), "\n".join(map(line, rows))


def darker(material, albedo=1.0, emission=1.0):
    return Material(np.minimum(material.albedo * albedo, 1), material.emission * emission)


@dataclass(frozen=True)
class Broken:
    """`numba` with a mistake."""

    mistake: str
    surface: str = "levelset"
    geometry = "both"

    @property
    def name(self):
        return self.mistake

    def solve(self, scene, queries, **how):
        asked, changes = queries, {}
        if self.mistake == "albedo":
            changes = {"albedo": 0.97}
        if self.mistake == "lamps":
            quads = tuple(replace(q, material=darker(q.material, emission=1.02)) for q in scene.quads)
            scene = replace(scene, quads=quads)
        if self.mistake == "normals":
            asked = replace(queries, normal=-queries.normal)
        if self.mistake == "bounces":
            how["bounces"] += 1
        if changes:
            parts = {
                kind: tuple(replace(p, material=darker(p.material, **changes)) for p in getattr(scene, kind))
                for kind in ("fields", "quads")
            }
            scene = replace(scene, **parts)
        answer = Numba(surface=self.surface).solve(scene, asked, **how)
        if self.mistake == "holes":
            rows = np.arange(len(queries)) % 7 == 0
            empty = np.where(rows[:, None], 0, answer.mean), np.where(rows[:, None], 0, answer.m2)
            answer = Samples(queries, *empty, np.where(rows, 0, answer.paths))
        if self.mistake == "one query":
            answer.light[-1] *= 1.5
        return answer


FINDS = {
    "albedo": [
        "white furnace, noise",
        "sealed furnace, noise",
        "sealed furnace, glowing walls",
        "gray box with a lamp",
    ],
    "lamps": ["sealed furnace, glowing walls", "rectangular lamp", "gray box with a lamp", "energy in the box"],
    "normals": ["linear field, unit sky", "ball, unit sky", "floor beside a ball", "ball over a floor"],
    "bounces": ["sealed furnace, noise", "sealed furnace, glowing walls", "gray box with a lamp"],
    "holes": ["linear field, unit sky", "ball, unit sky", "rectangular lamp"],
    "one query": ["sealed furnace, noise", "linear field, unit sky", "ball, unit sky", "floor beside a ball"],
}


@pytest.mark.parametrize("surface", ["levelset", "mesh"])
@pytest.mark.parametrize("mistake", FINDS)
def test_a_mistake_is_found_at_the_default_number_of_paths(mistake, surface, cases):
    rows = list(
        check({mistake: Broken(mistake, surface)}, cases=[case for case in cases if case.name in FINDS[mistake]])
    )
    assert [row.scene for row in rows if not row.agrees] == FINDS[mistake], "\n".join(map(line, rows))
    assert all("DISAGREES" in line(row) for row in rows)


def test_lamberts_formula_is_the_integral_over_the_lamp():
    quad = Quad("lamp", [1.0, 2.0, 3.0], [2.0, 0.5, 0.3], [-0.4, 1.5, 1.0])
    point, normal = np.array([0.3, 0.1, -0.2]), np.array([0.6, 0.0, 0.8])
    share = (np.arange(400) + 0.5) / 400
    u, v = (s.ravel()[:, None] for s in np.meshgrid(share, share))
    ray = quad.corner + u * quad.edge_u + v * quad.edge_v - point
    distance = np.linalg.norm(ray, axis=1)
    factor = (ray @ normal) * np.abs(ray @ quad.normal) / distance**4
    assert analytic.lambert(point, normal, quad) == pytest.approx(factor.mean() * quad.area, rel=1e-5)


def test_the_ball_lies_between_the_spheres_of_its_bound():
    field = analytic.ball()
    directions = np.random.default_rng(0).normal(size=(5000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for square, side in ((144.0, -1), (144.0 - 0.75, 1)):
        h = interpolate(field.volume, world_to_index(field.volume, np.sqrt(square) * directions))
        assert (side * (h + 144.0) >= -1e-4).all()


def test_the_gradient_normal_of_the_ball_is_that_of_the_sphere():
    case = analytic.convex()
    outward = case.queries.point / np.linalg.norm(case.queries.point, axis=1, keepdims=True)
    np.testing.assert_allclose(case.queries.normal, outward, atol=1e-6)


def test_the_lit_surfaces_of_the_box_close_it(cases):
    # The vector areas of a closed surface cancel: of what is not buried, inside the box, up to the cells at its edges.
    case = next(case for case in cases if case.name == "gray box with a lamp")
    lit = Numba().solve(case.scene, case.queries, paths=range(1), bounces=0, seed=0).paths > 0
    whole = case.area[lit] @ case.queries.normal[lit]
    assert np.linalg.norm(whole) < 0.01 * case.area[lit].sum()


def test_a_case_without_noise_is_judged_by_its_bound_alone():
    case = analytic.plane()
    good = judge(case, Numba(), 1000, 0, 4.0, 5.0)
    assert good.agrees
    assert abs(good.z) < 1
    off = replace(case, expected=case.expected * (1 + 2e-5))
    assert not judge(off, Numba(), 1000, 0, 4.0, 5.0).agrees


def test_the_largest_seed_has_another_beside_it():
    assert all(row.agrees for row in check(contenders(["numba"]), 1000, 2**64 - 1, [analytic.plane()]))


def test_sidak_corrects_for_the_number_of_tests():
    assert sidak(1, 0.05) == pytest.approx(1.95996, abs=1e-5)
    assert sidak(100, 0.05) == pytest.approx(3.4739, abs=1e-3)


def test_ids_of_a_case_are_unique(cases):
    for case in cases:
        assert len(np.unique(case.queries.id)) == len(case.queries), case.name
        assert isinstance(case.queries, Queries)
        assert case.queries.normal.any(axis=1).all(), case.name


def test_no_path_is_bad_input():
    with pytest.raises(BadInput, match="at least 1"):
        check(contenders(["numba"]), paths=0)


def test_what_is_not_installed_is_left_out_and_one_name_is_both_surfaces(monkeypatch):
    monkeypatch.setattr(registry.entry("backend", "embree").stage, "available", lambda: "pip install embreex")
    assert list(contenders()) == ["numba:levelset", "numba:mesh", "reference"]
    rows = check(contenders(["numba"]), paths=500, cases=[analytic.plane(), analytic.cavity(on_voxels=True)])
    assert [(row.backend, row.scene) for row in rows] == [
        ("numba:levelset", "linear field, unit sky"),
        ("numba:levelset", "sealed furnace, voxels"),
        ("numba:mesh", "linear field, unit sky"),
    ]
    with pytest.raises(BadInput, match="pip install embreex"):
        contenders(["embree"])


def command(*arguments):
    return cli.guarded(lambda: cli.app(["verify", *arguments], standalone_mode=False))


def test_the_command_prints_a_table(capsys, monkeypatch):
    monkeypatch.setattr(verify, "CASES", (analytic.plane, analytic.shadow))
    assert command("--backend", "numba:mesh", "--paths", "5000") == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].split() == ["scene", "backend", "expected", "measured", "z", "max", "|z|", "verdict"]
    assert "E = π" in said[1] and "agrees" in said[1]
    assert said[-1] == "2 of 2 agree"


def test_the_command_exits_with_1_if_a_backend_disagrees(capsys, monkeypatch):
    monkeypatch.setattr(verify, "CASES", (analytic.plane,))
    monkeypatch.setattr(registry, "backend", lambda name, **options: Broken("normals"))
    assert command("--backend", "broken") == 1
    assert "DISAGREES" in capsys.readouterr().out
    monkeypatch.undo()
    for options, words in (("--backend", "nonesuch"), "nonesuch"), (("--paths", str(2**31)), "fewer than 2**31"):
        assert command(*options) == 2
        said = capsys.readouterr()
        assert words in said.err and not said.out  # not even the head of the table
