"""The stages of a running command, as its log shows them."""

from __future__ import annotations

from calibray.cli.console import line
from calibray.window.jobs import Stage, stages


def test_lines_of_progress_are_read_back_and_the_last_of_a_stage_counts():
    log = "\n".join(
        [
            line("starting", 0, None, 4.0),
            line("tracing", 30, 120, 15.0),
            line("tracing", 90, 120, 45.0),
            line("links without a path", 3, None, 9.0),
            line("calibrating: best RMSE 3.21 dB", 100, 400, 8.0),
            line("calibrating: best RMSE 0.53 dB", 300, 400, 24.0),
        ]
    )
    assert stages(log) == [
        Stage("starting", None, 4, None, ""),
        Stage("tracing", 0.75, 45, 15, ""),
        Stage("links without a path", None, 9, None, ""),
        Stage("calibrating", 0.75, 24, 8, "best RMSE 0.53 dB"),
    ]


def test_other_lines_of_a_log_are_no_stages():
    log = "RMSE [dB]   calibration links\nWarning: a, 5 s b\nbefore   15.53\nError: no column\n\n3/4, 1 s\n"
    assert stages(log) == []
    assert stages(line("tracing", 0, 0, 3.0))[0].share is None
