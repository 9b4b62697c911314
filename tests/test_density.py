"""Points to a field: total and moments from theory, files of every kind, refusals."""

import numpy as np
import pytest

import illumgrid as ig
from illumgrid.io import needs
from illumgrid.io.points import density_of_file
from illumgrid.io.readers.points import read_points
from shapes import refused

POINTS = np.random.default_rng(0).random((300, 3)) * [4, 5, 6] + [10, -20, 3]
WEIGHTS = np.random.default_rng(1).random(300) + 0.5


def total(volume):
    return np.asarray(volume.values, float).sum() * np.prod(volume.spacing)


def axes(volume):
    """Coordinates of the voxels along each axis."""
    return [volume.origin[a] + volume.spacing[a] * np.arange(volume.shape[a]) for a in range(3)]


@pytest.mark.parametrize("spacing", [0.5, (0.4, 0.7, 0.3)])
@pytest.mark.parametrize("sigma", [0.0, 0.8])
def test_the_total_is_that_of_the_weights(spacing, sigma):
    volume = ig.density(POINTS, spacing=spacing, sigma=sigma, weights=WEIGHTS)
    assert abs(total(volume) / WEIGHTS.sum() - 1) < 1e-5
    lowest, highest = (np.array([f(axis) for axis in axes(volume)]) for f in (np.min, np.max))
    assert (lowest <= POINTS.min(axis=0) - 4 * sigma).all() and (highest >= POINTS.max(axis=0) + 4 * sigma).all()
    assert np.allclose(volume.origin / spacing, np.rint(volume.origin / spacing), atol=1e-9)


def test_a_periodic_cell_keeps_the_total_and_is_the_same_from_everywhere():
    cell = (4.1, 5.0, 6.3)
    one = ig.density(POINTS, spacing=0.5, sigma=0.9, weights=WEIGHTS, cell=cell)
    assert abs(total(one) / WEIGHTS.sum() - 1) < 1e-5
    assert np.allclose(one.spacing * one.shape, cell)
    around = ig.density(POINTS + np.array([1, -2, 3]) * cell, spacing=0.5, sigma=0.9, weights=WEIGHTS, cell=cell)
    assert np.allclose(one.values, around.values, rtol=1e-5)
    moved = ig.density(POINTS + 3 * one.spacing, spacing=0.5, sigma=0.9, weights=WEIGHTS, cell=cell)
    assert np.allclose(np.roll(one.values, (3, 3, 3), (0, 1, 2)), moved.values, rtol=1e-5)


SKEWED = np.array([[4.1, 0, 0], [1.3, 5.0, 0], [-2.2, 1.9, 6.3]])
TURN = np.array([[2.0, -1.0, 2.0], [2.0, 2.0, -1.0], [-1.0, 2.0, 2.0]]) / 3


@pytest.mark.parametrize("cell", [SKEWED, SKEWED @ TURN, SKEWED * [[1], [1], [-1]], SKEWED[[1, 2, 0]]])
@pytest.mark.parametrize("sigma", [0.0, 0.9])
def test_a_skewed_cell_keeps_the_total_and_is_the_same_from_everywhere(cell, sigma):
    one = ig.density(POINTS, spacing=(0.5, 0.4, 0.6), sigma=sigma, weights=WEIGHTS, cell=cell)
    assert abs(total(one) / WEIGHTS.sum() - 1) < 1e-5
    assert np.isclose(np.prod(one.spacing * one.shape), np.linalg.det(SKEWED))
    assert np.allclose(one.direction @ one.direction.T, np.eye(3)) and np.linalg.det(one.direction) > 0
    shifts = np.random.default_rng(2).integers(-2, 3, (len(POINTS), 3))
    around = ig.density(POINTS + shifts @ cell, spacing=(0.5, 0.4, 0.6), sigma=sigma, weights=WEIGHTS, cell=cell)
    assert np.allclose(one.values, around.values, rtol=1e-4, atol=1e-4 * one.values.max())


def test_a_skewed_cell_holds_the_sum_of_the_gaussians_of_all_images():
    # The deposit differs from a Gaussian by a share of (h / sigma)²; half the spacing leaves a quarter of it.
    off = []
    for spacing in (0.4, 0.2):
        volume = ig.density(POINTS[:20], spacing=spacing, sigma=0.8, cell=SKEWED @ TURN)
        index = np.random.default_rng(3).integers(0, np.array(volume.shape), (60, 3))
        at = volume.origin + (index * volume.spacing) @ volume.direction.T
        steps = np.stack(np.meshgrid(*[np.arange(-9, 10)] * 3), axis=-1).reshape(-1, 3) @ (SKEWED @ TURN)
        away = ((at[:, None, None] - POINTS[:20, None] - steps) ** 2).sum(axis=-1)
        truth = np.exp(-away / (2 * 0.8**2)).sum(axis=(1, 2)) / (2 * np.pi * 0.8**2) ** 1.5
        off.append(np.abs(volume.values[tuple(index.T)] - truth).mean() / truth.mean())
    assert off[0] < 0.05 and off[1] < 0.4 * off[0]


def test_skewed_edges_of_an_upright_cell_make_the_same_field():
    upright = ig.density(POINTS, spacing=0.5, sigma=0.9, cell=(4, 5, 6))
    skewed = ig.density(POINTS, spacing=0.5, sigma=0.9, cell=[[4, 0, 0], [4, 5, 0], [-8, 5, 6]])
    assert np.allclose(upright.values, skewed.values, rtol=1e-5)


def test_centre_of_mass_and_variance_are_those_of_the_gaussian():
    # Points at 8 equal offsets within a voxel along each axis: of these the mean of f (1 - f), the variance of a share,
    # is 1/6 + 1/384 voxels² (midpoint rule), and a Gaussian that ends at 4 sigma has 0.9989 of its variance.
    offsets = (np.stack(np.meshgrid(*[np.arange(8)] * 3), axis=-1).reshape(-1, 3) + 0.5) / 8
    for sigma in (1.0, 2.5):
        volume = ig.density(offsets, spacing=1.0, sigma=sigma)
        share = np.asarray(volume.values, float) / volume.values.sum(dtype=float)
        for axis, at in enumerate(axes(volume)):
            along = share.sum(axis=tuple({0, 1, 2} - {axis}))
            centre = (along * at).sum()
            spread = (along * (at - centre) ** 2).sum() - offsets[:, axis].var()
            assert abs(centre - 0.5) < 1e-6
            assert abs(spread / sigma**2 - 1) < 0.0011 + 1 / 384 / sigma**2


def test_finer_voxels_come_nearer_to_the_sum_of_gaussians():
    sigma, worst = 1.0, []
    for spacing in (0.5, 0.25):
        volume = ig.density(POINTS, spacing=spacing, sigma=sigma, weights=WEIGHTS)
        along = [np.exp(-((at[:, None] - POINTS[:, a]) ** 2) / 2) for a, at in enumerate(axes(volume))]
        exact = np.einsum("in,jn,kn,n->ijk", *along, WEIGHTS) / (2 * np.pi) ** 1.5
        worst.append(np.sqrt(((volume.values - exact) ** 2).mean()) / exact.max())
    # The variance of each point is off by at most h²/6 of sigma²: second order, 1/24 of the density at h = sigma / 2.
    assert worst[0] < 1 / 24 and worst[1] < worst[0] / 3


@pytest.mark.parametrize(
    ("name", "content", "options"),
    [
        ("a.csv", "x,y,z,mass\n1,2,3,4\n5,6,7,8\n", {"weights": "mass"}),
        ("a.csv", '"Mass"; "Z"; "X"; "Y"\n4;3;1;2\n8;7;5;6\n', {"weights": "mass"}),
        ("a.csv", "t,right,up,back,q\n0,1,2,3,4\n0,5,6,7,8\n", {"columns": ["right", "up", "back"], "weights": "q"}),
        ("a.txt", "# x y z\n1 2 3 4\n5 6 7 8\n", {}),
        ("a.tsv", "1\t2\t3\t4\n5\t6\t7\t8\n", {"weights": "3"}),
        ("a.xyz", "2\nwater\nO 1 2 3\nH 5 6 7\n", {}),
        (
            "a.xyz",
            '2\nLattice="9 0 0 0 8 0 0 0 7" Properties=species:S:1:charge:R:1:pos:R:3\nO 4 1 2 3\nH 8 5 6 7\n',
            {"weights": "charge"},
        ),
    ],
)
def test_tables_and_xyz_are_read_by_name(tmp_path, name, content, options):
    (tmp_path / name).write_text(content)
    if name == "a.txt":
        options, content = {}, content.replace("# x y z\n", "")
    cloud = read_points(tmp_path / name, **options)
    assert cloud.points.tolist() == [[1, 2, 3], [5, 6, 7]]
    assert cloud.weights is None if "weights" not in options else cloud.weights.tolist() == [4, 8]
    assert cloud.periodic() == [9, 8, 7] if "Lattice" in content else cloud.cell is None


def test_arrays_of_numpy_are_read(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[1, 2, 3, 4], [5, 6, 7, 8]], np.float32))
    table = np.array([(4, 1, 2, 3), (8, 5, 6, 7)], [("m", "f4"), ("x", "f8"), ("y", "f8"), ("z", "f8")])
    np.save(tmp_path / "b.npy", table)
    for name, weights in (("a.npy", "3"), ("b.npy", "m")):
        cloud = read_points(tmp_path / name, weights=weights)
        assert cloud.points.tolist() == [[1, 2, 3], [5, 6, 7]] and cloud.weights.tolist() == [4, 8]


ATOM = "ATOM      1  N   MET A   1      27.340  24.430   2.614  1.00  9.67           N\n"
OTHER = "HETATM    2  C   MET A   1      26.266  25.413   2.842  0.50 10.00           C\n"
CELL = "CRYST1   50.000   51.000   52.000  90.00  {}  90.00 P 1           1\n"
MMCIF = """data_A
loop_
_atom_site.group_PDB
_atom_site.id
_atom_site.type_symbol
_atom_site.label_atom_id
_atom_site.label_alt_id
_atom_site.label_comp_id
_atom_site.label_asym_id
_atom_site.label_entity_id
_atom_site.label_seq_id
_atom_site.pdbx_PDB_ins_code
_atom_site.Cartn_x
_atom_site.Cartn_y
_atom_site.Cartn_z
_atom_site.occupancy
_atom_site.B_iso_or_equiv
ATOM 1 N N . MET A 1 1 ? 27.340 24.430 2.614 1.00 9.67
HETATM 2 C C . MET A 1 1 ? 26.266 25.413 2.842 0.50 10.00
"""


@pytest.mark.parametrize(("name", "content"), [("a.pdb", CELL.format("90.00") + ATOM + OTHER), ("a.cif", MMCIF)])
def test_atoms_count_by_their_occupancy(tmp_path, name, content):
    (tmp_path / name).write_text(content)
    cloud = read_points(tmp_path / name)
    assert np.allclose(cloud.points, [[27.34, 24.43, 2.614], [26.266, 25.413, 2.842]]) and cloud.unit == "Å"
    assert cloud.weights.tolist() == [1, 0.5]
    assert np.allclose(read_points(tmp_path / name, weights="mass").weights, [14.007, 0.5 * 12.011], atol=1e-3)
    assert np.allclose(read_points(tmp_path / name, weights="b_factor").weights, [9.67, 10])
    if name == "a.pdb":
        assert cloud.periodic() == [50, 51, 52]
        (tmp_path / name).write_text(CELL.format("93.00") + ATOM)
        volume = density_of_file(tmp_path / name, spacing=2.0, sigma=3.0, cell="file")
        assert abs(total(volume) - 1) < 1e-5 and np.allclose(read_points(tmp_path / name).periodic()[0], [50, 0, 0])


def test_elements_of_xyz_have_masses(tmp_path):
    (tmp_path / "a.xyz").write_text("2\n\nO 0 0 0\nH 1 0 0\n")
    assert np.allclose(read_points(tmp_path / "a.xyz", weights="mass").weights, [15.999, 1.008], atol=1e-3)
    assert read_points(tmp_path / "a.xyz", weights="number").weights.tolist() == [8, 1]
    (tmp_path / "a.xyz").write_text("1\n\nO 0 0 0\n1\n\nO 1 0 0\n")
    with pytest.warns(ig.IllumgridWarning, match="several frames"):
        assert len(read_points(tmp_path / "a.xyz").points) == 1


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.csv", "x,y,z\n1,2\n", ["a.csv", "was not understood"]),
        ("a.csv", "x,y\n1,2\n", ["2 columns", "at least three"]),
        ("a.csv", "\n#\n", ["no numbers"]),
        ("a.csv", "", ["empty"]),
        ("a.csv", "x,y,z\n1,2,nan\n", ["point 0", "finite"]),
        ("a.csv", "x,y,z\n", ["shape (0, 3)"]),
        ("a.xyz", "5\n\nO 1 2 3\n", ["5 atoms"]),
        ("a.xyz", "water\n\nO 1 2 3\n", ["number of atoms"]),
        ("a.pdb", "hello\n", ["no atoms"]),
        ("a.cif", "hello\n", ["not understood"]),
        ("a.bin", "\0\1", ["not text"]),
        ("a.npy", b"\x93NUMPY", ["a.npy"]),
    ],
)
@pytest.mark.filterwarnings("ignore:loadtxt:UserWarning")
def test_files_that_hold_no_points_are_refused(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    refused(lambda: density_of_file(tmp_path / name, spacing=1, sigma=1), *words)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"spacing": 0}, ["spacing is 0", "positive"]),
        ({"spacing": "a"}, ["spacing is 'a'"]),
        ({"sigma": -1}, ["sigma is -1"]),
        ({"sigma": np.nan}, ["sigma is nan"]),
        ({"weights": [1, 2]}, ["weights have shape (2,)"]),
        ({"cell": (4, -5, 6)}, ["cell is [4, -5, 6]"]),
        ({"cell": np.ones((3, 3))}, ["the edges of the cell are [[1", "span a volume"]),
        ({"cell": (4, 5, 6), "sigma": 5}, ["sigma is 5", "at most 4"]),
        ({"spacing": 1e-9}, ["voxels along an axis", "choose it larger"]),
        ({"spacing": 1e-4}, ["the density needs", "larger spacing"]),
        ({"points": np.zeros((3, 2))}, ["shape (3, 2)"]),
        ({"points": np.zeros((0, 3))}, ["shape (0, 3)"]),
        ({"points": [[0, 0, np.inf]]}, ["point 0", "inf"]),
    ],
)
def test_nonsense_is_refused_in_a_sentence(options, words):
    given = {"points": POINTS, "spacing": 0.5, "sigma": 1.0, **options}
    refused(lambda: ig.density(given.pop("points"), **given), *words)


@pytest.mark.parametrize("ending", [".nrrd", ".vti", ".npz"])
def test_the_command_writes_what_is_read_back(call, tmp_path, ending):
    np.savetxt(tmp_path / "p.csv", np.column_stack([POINTS, WEIGHTS]), delimiter=",", header="x,y,z,m", comments="")
    said = call("density", "p.csv", "-o", f"d{ending}", "--spacing", "0.5", "--sigma", "0.8", "--weights", "m")
    assert f"wrote d{ending}: density" in said
    volume = ig.read_volume(tmp_path / f"d{ending}")
    expected = ig.density(POINTS, spacing=0.5, sigma=0.8, weights=WEIGHTS)
    assert np.allclose(volume.values, expected.values, rtol=1e-6) and np.allclose(volume.origin, expected.origin)
    call("density", "p.csv", "-o", f"e{ending}", "--spacing", "0.5", "--sigma", "0.8", "--cell", "4.1,5,6.3")
    assert np.allclose(ig.read_volume(tmp_path / f"e{ending}").spacing, [4.1 / 8, 0.5, 6.3 / 13])


def test_the_command_refuses_before_it_writes(refuse, tmp_path, monkeypatch):
    np.savetxt(tmp_path / "p.csv", POINTS, delimiter=",", header="x,y,z", comments="")
    given = ("density", "p.csv", "--spacing", "0.5", "--sigma", "0.8")
    refuse(*given, "-o", "d.tif", words=["d.tif", ".nrrd, .vti, .npz"])
    refuse(*given, "-o", "d.nrrd", "--weights", "mass", words=["no column 'mass'", "x, y, z"])
    refuse(*given, "-o", "d.nrrd", "--columns", "x", "y", "w", words=["no column 'w'"])
    refuse(*given, "-o", "d.nrrd", "--cell", "1,2", words=["--cell is '1,2'"])
    refuse(*given, "-o", "d.nrrd", "--cell", "file", words=["no periodic cell"])
    refuse("density", "none.csv", *given[2:], "-o", "d.nrrd", words=["none.csv", "no such file"])
    monkeypatch.setattr(needs, "free_memory", lambda: 1000)
    refuse(*given, "-o", "d.nrrd", words=["the density needs"])


SCENE = (
    '[[field]]\nname = "a"\npoints = "p.csv"\nspacing = 0.5\nsigma = 0.8\nrange = [1, 2]\nalbedo = [0.2, 0.3, 0.4]\n'
)


def test_scene_files_take_points_in_place_of_a_volume(tmp_path):
    np.savetxt(tmp_path / "p.csv", np.column_stack([POINTS, WEIGHTS]), delimiter=",", header="x,y,z,m", comments="")
    (tmp_path / "s.toml").write_text(SCENE + SCENE.replace('"a"', '"b"\nweights = "m"').replace("0.5", "[0.5, 0.5, 1]"))
    one, other = ig.read_scene(tmp_path / "s.toml").fields
    expected = ig.density(POINTS, spacing=0.5, sigma=0.8)
    assert np.array_equal(one.volume.values, expected.values) and one.material.albedo.tolist() == [0.2, 0.3, 0.4]
    assert other.volume.spacing[2] == 1 and abs(total(other.volume) / WEIGHTS.sum() - 1) < 1e-5
    for old, new, words in (
        ("sigma = 0.8\n", "", ["'a'", "sigma is missing"]),
        ("sigma = 0.8", 'sigma = "wide"', ["sigma is 'wide'"]),
        ("sigma = 0.8", "sigma = 0.8\nchannel = 1", ["no key 'channel'"]),
        ("sigma = 0.8", 'sigma = 0.8\nvolume = "p.npy"', ["points and volume came together"]),
        ("sigma = 0.8", "sigma = 0.8\ncell = [1, 2]", ["cell is [1, 2]"]),
        ("p.csv", "q.csv", ["points: q.csv", "no such file"]),
    ):
        (tmp_path / "s.toml").write_text(SCENE.replace(old, new))
        refused(lambda: ig.read_scene(tmp_path / "s.toml"), *words)
