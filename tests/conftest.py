"""The command line as a function, shared by all its tests."""

import numpy as np
import pytest

from illumgrid import chain, cli
from illumgrid import show as preview
from shapes import ball

# A judgement takes longer than the runs of most tests: those that are about it ask for it. The command line judges.
chain.run.__kwdefaults__["judge"] = False


@pytest.fixture
def call(capsys, tmp_path, monkeypatch):
    """Run a command in its own folder, with small pictures; returns its output."""
    monkeypatch.setattr(preview.render, "__kwdefaults__", {**preview.render.__kwdefaults__, "width": 64, "height": 48})
    monkeypatch.chdir(tmp_path)
    np.save(tmp_path / "v.npy", ball(10).values)

    def call(*args, code=0):
        result = cli.guarded(lambda: cli.app([str(a) for a in args], standalone_mode=False))
        said = "".join(capsys.readouterr())
        assert result == code, said
        assert "Traceback" not in said
        return said

    return call


@pytest.fixture
def refuse(call, tmp_path):
    """A command is refused in one sentence that contains these words, and writes nothing."""

    def refuse(*args, words):
        before = sorted(tmp_path.rglob("*"))
        said = call(*args, code=2).strip()
        assert said.count("\n") == 0 and said.startswith("illumgrid: ") and ". " not in said, said
        for word in words:
            assert word in said, said
        assert sorted(tmp_path.rglob("*")) == before

    return refuse
