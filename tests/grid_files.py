"""Writes Gaussian cube and OpenDX files as their manuals do, for the tests of the readers."""

import numpy as np

START, STEP = (10.0, -20.0, 30.0), (1.5, 2.0, 3.0)
NOISE = np.random.default_rng(5).normal(size=(5, 6, 7))


def cube_file(path, fields=NOISE[..., None], atoms=1, sign=1, steps=None, orbitals=None, last=""):
    """As https://gaussian.com/cubegen/ describes it: the third axis runs fastest."""
    n, steps = fields.shape[:3], np.diag(STEP) if steps is None else steps
    lines = ["title", "what it is", f"{atoms} " + " ".join(map(str, START)) + last]
    lines += [f"{sign * n[k]} " + " ".join(map(str, steps[k])) for k in range(3)]
    lines += ["6 6.0 1.0 2.0 3.0"] * abs(atoms)
    if orbitals:
        lines.append(" ".join(map(str, [len(orbitals), *orbitals])))
    for row in fields.reshape(n[0] * n[1], -1):
        lines += [" ".join(f"{v:13.5E}" for v in row[k : k + 6]) for k in range(0, len(row), 6)]
    path.write_text("\n".join(lines) + "\n")
    return path


def dx_file(
    path, binary="", tail='attribute "dep" string "positions"\nobject "regular positions regular connections"\n'
):
    """As APBS writes it: the third axis runs fastest."""
    head = "# Comments\n#\nobject 1 class gridpositions counts 5 6 7\norigin " + " ".join(map(str, START)) + "\n"
    head += "".join(f"delta {' '.join(map(str, row))}\n" for row in np.diag(STEP))
    head += "object 2 class gridconnections counts 5 6 7\n"
    head += f"object 3 class array type double rank 0 items 210 {binary}data follows\n"
    if binary:
        path.write_bytes(head.encode() + NOISE.astype("<f8").tobytes() + b"\n" + tail.encode())
    else:
        flat = NOISE.ravel()
        text = "\n".join(" ".join(f"{v:.6E}" for v in flat[k : k + 3]) for k in range(0, 210, 3))
        path.write_text(f"{head}{text}\n{tail}")
    return path
