"""Fields that transmit: thin shells that light goes straight through, and what lies inside them."""

import math
from dataclasses import replace

import numpy as np
import pytest

import naive
from illumgrid.backends.numba_ import Numba
from illumgrid.backends.reference import Reference
from illumgrid.chain import load, run
from illumgrid.field.scene import Field, Material, Quad, Scene
from illumgrid.grid.cache import cache_of
from illumgrid.transport.samples import Queries
from illumgrid.transport.tracer import prepare
from rooms import ROOMS
from shapes import ball, refused
from test_cache import ALIKE, made_up, questions, two_fields, worth
from transport import colored, everywhere, furnace, noise, on_sets, waves

SAME = 1e-6  # of π, as in the oracle chain


def films(scene, *transmissions):
    """The same scene, its first fields transmitting, with albedos that leave room for that and no emission."""
    fields = list(scene.fields)
    for k, share in enumerate(transmissions):
        fields[k] = replace(fields[k], material=Material((1 - share) * fields[k].material.albedo, transmission=share))
    return replace(scene, fields=tuple(fields))


SCENES = {
    "smooth": lambda: films(colored(furnace(waves((6, 10, 13)))), 0.6),
    "below": lambda: films(colored(furnace(waves(), inside="below")), 0.3),
    "bytes": lambda: films(colored(furnace(noise(256, (5, 5, 6)))), 0.7),
    "one of two": lambda: films(two_fields(), 0.5),
    "two": lambda: films(two_fields(), 0.5, 0.7),
    **{name: (lambda name=name: films(ROOMS[name](), 0.6)) for name in list(ROOMS)[:2]},
}


@pytest.mark.plain
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("known", [False, True])
def test_loops_numpy_and_kernels_follow_the_same_paths(name, known):
    scene = SCENES[name]()
    grids, walls = made_up(scene)
    cache = (cache_of(scene, grids, walls, ALIKE),) if known else ()
    queries = questions(scene, 20)
    tracers = [prepare(backend, scene, *cache) for backend in (Numba(), Reference())]
    through = 0
    for path, bounces in enumerate((0, 1, 4)):
        one, answered = worth(tracers[0], queries, path, bounces)
        other, _ = worth(tracers[1], queries, path, bounces)
        rows = np.flatnonzero(answered)
        light = (grids, walls, ALIKE) if known else None
        truth = np.array([naive.path_worth(scene, queries[i : i + 1], path, bounces, 0, light) for i in rows])
        np.testing.assert_allclose(one[rows], truth, atol=SAME, rtol=SAME)
        np.testing.assert_allclose(other[rows], truth, atol=SAME, rtol=SAME)
        opaque = replace(
            scene, fields=tuple(replace(f, material=replace(f.material, transmission=0.0)) for f in scene.fields)
        )
        through += (np.abs(one - worth(prepare(Numba(), opaque), queries, path, bounces)[0]) > SAME).any(axis=1).sum()
    assert through > 3


@pytest.mark.parametrize(
    "make", [lambda: furnace(waves((6, 10, 13))), lambda: replace(two_fields(), background=np.ones(3))]
)
def test_a_furnace_with_films_is_white(make):
    """Under a sky of 1, films that absorb nothing, and bodies that emit 1 - a: radiance is 1 everywhere."""
    scene = make()
    materials = [Material(np.full(3, 0.4), transmission=0.6), Material((0.3, 0.2, 0.1), (0.7, 0.8, 0.9))]
    scene = replace(scene, fields=tuple(replace(f, material=m) for f, m in zip(scene.fields, materials)))
    answer = prepare(Numba(), scene).solve(everywhere(scene), paths=range(4), bounces=60, seed=0)
    good = answer.paths > 0
    assert good.mean() > 0.3
    np.testing.assert_allclose(answer.mean[good], math.pi, rtol=1e-4)


def shell(albedo, transmission, sky=2.0):
    """A ball that reflects all, within a closed shell, under a uniform sky."""
    film = Material(np.full(3, albedo), transmission=transmission)
    fields = (
        Field("film", ball(14), film, (0.3, 0.5)),
        Field("ball", ball(14), Material(np.ones(3)), (0.9, 1.0)),
    )
    return Scene(fields, background=np.full(3, sky))


@pytest.mark.parametrize("backend", [Numba(), Reference()])
def test_inside_a_closed_shell_light_has_its_closed_form(backend):
    """E = π τ L / (1 - a) within; the outer side of a convex shell sees the sky alone: E = π L."""
    scene = shell(0.3, 0.5)
    queries = on_sets(scene, 2, 60)
    answer = prepare(backend, scene).solve(queries, paths=range(64), bounces=24, seed=0)
    inner = queries.target == 1
    assert (answer.paths > 0).all()
    mean, stderr = answer.mean[inner, 0].astype(float).mean(), answer.stderr[inner, 0].astype(float).mean()
    truth = math.pi * 0.5 * 2.0 / (1 - 0.3)
    assert abs(mean - truth) < 4 * stderr / math.sqrt(inner.sum()) + 2e-3 * truth
    # On a trilinear sphere a few directions dip under the surface, and go in: as much comes out from there as bounces.
    assert abs(answer.mean[~inner, 0].mean() / (2 * math.pi) - 1) < 0.02


def test_a_film_that_reflects_nothing_is_as_if_it_were_not_there():
    """Transmission 1, albedo 0, around a ball on a wide floor under a lamp: the same paths as without the film."""
    floor = Quad("floor", (-4, -4, -1.3), (8, 0, 0), (0, 8, 0), Material(np.full(3, 0.5)))
    lamp = Quad("lamp", (-1, -1, 3), (0, 2, 0), (2, 0, 0), Material(np.zeros(3), np.full(3, 5.0)))
    body = Field("ball", ball(12), Material(np.full(3, 0.6)), (0.8, 1.0))
    film = Field("film", ball(12), Material(np.zeros(3), transmission=1.0), (0.3, 0.5))
    with_film, without = (Scene(f, (floor, lamp), np.full(3, 0.1)) for f in ((body, film), (body,)))
    asked = on_sets(with_film, 2, 40)
    asked = asked[asked.target == 0]
    plain = Queries(asked.id, asked.point, asked.normal, asked.level[:, :1], asked.target)
    light = [
        prepare(Numba(), scene).solve(q, paths=range(16), bounces=3, seed=0).mean
        for scene, q in ((with_film, asked), (without, plain))
    ]
    np.testing.assert_allclose(light[0], light[1], rtol=1e-6)
    assert light[0].max() > 1.5 * light[0].min() > 0


def test_a_query_within_a_film_is_no_hole_and_one_within_a_solid_is():
    scene = shell(0.3, 0.5)
    opaque = replace(scene, fields=(replace(scene.fields[0], material=Material()), scene.fields[1]))
    asked = on_sets(scene, 1, 20)
    walked = [prepare(Numba(), s).solve(asked, paths=range(2), bounces=1, seed=0).paths > 0 for s in (scene, opaque)]
    inner = asked.target == 1
    assert walked[0].all() and not walked[1][inner].any() and walked[1][~inner].all()


def test_materials_that_cannot_be_are_refused():
    refused(lambda: Material(transmission=1.5), "1.5", "0 to 1")
    refused(lambda: Material((0.8, 0.1, 0.1), transmission=0.3), "0.3", "0.8", "no more than 1")
    refused(lambda: Material(np.zeros(3), np.ones(3), 0.5), "emission")
    corner = ((0, 0, 0), (1, 0, 0), (0, 1, 0))
    refused(lambda: Quad("wall", *corner, Material(np.zeros(3), transmission=0.5)), "wall", "field only")
    refused(lambda: prepare(Numba(surface="mesh"), shell(0.3, 0.5)), "film", "levelset")


def test_a_run_keeps_what_transmits(tmp_path):
    light = run(shell(0.3, 0.5), grid=6, paths=2, bounces=2, seed=0)
    light.save(tmp_path / "run", preview=False)
    again = load(tmp_path / "run")
    assert [f.material.transmission for f in again.scene.fields] == [0.5, 0.0]
    assert np.array_equal(again.grids[1].values, light.grids[1].values)
