"""Kinds of engines: one file adds one, each has its own keys, and keys of another wait until it is chosen."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import calibray
import planted
from calibray.engines.kinds import KINDS
from calibray.errors import InputError
from calibray.study import Study
from calibray.study.toml_file import study_text

FREE_SPACE = '''
"""Free space with one unknown loss: the smallest engine there could be."""

from typing import ClassVar, Literal, final

import numpy as np

from calibray.engines.section import EngineSection


@final
class FreeSpaceSection(EngineSection):
    expensive: ClassVar[bool] = False
    external: ClassVar[bool] = True
    name: Literal["free-space"] = "free-space"
    exponent: float

    def answers_by(self, setup):
        return None

    def open(self, setup, paths, progress, workers):
        return FreeSpace(setup, self.exponent)


class FreeSpace:
    def __init__(self, setup, exponent):
        self.calls, self.parameters, self.materials = 0, setup.parameters, setup.scene.materials
        self._loss = 40 + 10 * exponent * np.log10(setup.links.distance)

    def path_loss(self, candidates):
        self.calls += len(candidates)
        return self._loss + candidates[:, :1]
'''
RUN = """
import sys
import calibray as cb

study = cb.Study.load(sys.argv[1])
result = cb.calibrate(study)
print(type(study.engine).__name__, *result.parameters.values(), result.rt_calls)
"""


STUDY = """
version = 1
[scene]
file = "sionna:simple_street_canyon"
frequency = 3.5e9
[links]
file = "links.csv"
tx = ["tx_x", "tx_y", "tx_z"]
rx = ["rx_x", "rx_y", "rx_z"]
value = "path_loss_db"
[parameters]
"concrete.relative_permittivity" = { bounds = [1.5, 12.0] }
[method]
name = "vector-surrogate"
options = { budget = 12 }
[engine]
name = "free-space"
exponent = 2.3
"""


def study(tmp_path: Path, **engine: object) -> Study:
    return planted.study(tmp_path, planted.links().assign(path_loss_db=90.0), engine=engine)


def test_a_kind_of_engine_is_added_by_one_file(tmp_path):
    """In a process of its own, on a copy of the package with that file put in."""
    package = tmp_path / "site" / "calibray"
    shutil.copytree(Path(calibray.__file__).parent, package)  # with its bytecode, which saves seconds
    (package / "engines" / "kinds" / "free_space.py").write_text(FREE_SPACE)
    links = planted.links()
    ends = (links[[f"{end}_{axis}" for axis in "xyz"]].to_numpy() for end in ("tx", "rx"))
    distance = np.linalg.norm(np.subtract(*ends), axis=1)
    links.assign(path_loss_db=40 + 23 * np.log10(distance) + 4.25).to_csv(tmp_path / "links.csv", index=False)
    (tmp_path / "study.toml").write_text(STUDY)
    ran = subprocess.run(
        [sys.executable, "-c", RUN, str(tmp_path / "study.toml")],
        env={**os.environ, "PYTHONPATH": str(package.parent)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    kind, value, calls = ran.stdout.split()
    assert (kind, calls) == ("FreeSpaceSection", "12")
    assert float(value) == pytest.approx(4.25, abs=0.01)


def test_every_kind_knows_its_own_keys_only(tmp_path):
    assert list(KINDS) == ["command", "replay", "retrace"]
    assert study(tmp_path, name="replay", compress_db=0.1).engine.compress_db == 0.1
    assert study(tmp_path, name="command", command=["model"]).engine.timeout == 3600
    with pytest.raises(InputError, match=r"engine\.time_out: unknown key; did you mean 'timeout'"):
        study(tmp_path, name="command", command=["model"], time_out=3.0)
    with pytest.raises(InputError, match=r"engine\.timeout = -1: must be greater than 0"):
        study(tmp_path, name="command", command=["model"], timeout=-1)
    with pytest.raises(InputError, match=r"engine\.name = 'replya': must be one of"):
        study(tmp_path, name="replya")


def test_keys_of_another_engine_wait_until_it_is_chosen(tmp_path):
    plan = study(tmp_path, name="replay", command=["model", "--fast"], timeout=7.5)
    assert not hasattr(plan.engine, "command")
    chosen = plan.replace(engine="command").engine
    assert (chosen.command, chosen.timeout) == (("model", "--fast"), 7.5)
    assert plan.content()["engine"] == {"name": "replay", "command": ["model", "--fast"], "timeout": 7.5}


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("timeout", -5, r"engine\.timeout = -5: must be greater than 0"),
        ("retries", 1.5, r"engine\.retries = 1\.5: must be a whole number"),
        ("command", [], r"engine\.command = \[\]: must not be empty"),
    ],
)
def test_keys_of_another_engine_are_checked_all_the_same(tmp_path, key, value, message):
    with pytest.raises(InputError, match=message):
        study(tmp_path, name="replay", **{key: value})


@pytest.mark.parametrize("name", [{}, {"name": "replay"}, {"name": "retrace"}])
def test_a_shared_key_with_the_value_of_an_engine_that_is_not_described_is_refused(tmp_path, name):
    """Such a study would trace instead of calling the program."""
    with pytest.raises(InputError, match=r"engine\.rays = true: .*or set engine\.name = 'command'"):
        study(tmp_path, rays=True, **name)
    assert study(tmp_path, rays=True, command=["model"], **name).replace(engine="command").engine.exports_rays


def test_a_shared_key_without_effect_is_announced(tmp_path, caplog):
    plan = study(tmp_path, name="replay", rays="links.csv", command=["model"])
    (tmp_path / "study.toml").write_text(study_text(plan.replace(engine="command").content(), {}))
    assert not caplog.records
    Study.load(tmp_path / "study.toml")
    assert (
        "engine.rays = 'links.csv' has no effect with engine.name = 'command'; correct or remove it"
        in caplog.text
    )
