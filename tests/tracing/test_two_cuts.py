"""MSI files in three layouts, the pattern between the cuts, and malformed files, refused with line and remedy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibray.errors import InputError
from calibray.tracing.gain_table import read_gain_table, read_two_cuts

ANGLES = np.arange(360)


def cuts() -> tuple[np.ndarray, np.ndarray]:
    """A 65-degree sector that points 15 degrees to the right, with 6 degrees of electrical downtilt."""
    horizontal = np.minimum(12 * (((ANGLES - 15 + 180) % 360 - 180) / 65) ** 2, 28.0)
    vertical = np.minimum(12 * (((ANGLES - 6 + 180) % 360 - 180) / 7) ** 2, 30.0)
    return horizontal, vertical


def classic() -> str:
    """Blanks between columns, gain in dBd, one decimal."""
    horizontal, vertical = cuts()
    head = "NAME 742215\nFREQUENCY 2140\nGAIN 15.85\nTILT ELECTRICAL\n"
    body = "".join(
        f"{name} 360\n" + "".join(f"{a:.1f} {v:.4f}\n" for a, v in zip(ANGLES, cut, strict=True))
        for name, cut in (("HORIZONTAL", horizontal), ("VERTICAL", vertical))
    )
    return head + body


def tabbed() -> str:
    """Tabs, Windows line ends, lower case, gain in dBi with its unit, a comment, vertical first, -180 to 179."""
    horizontal, vertical = cuts()
    body = "".join(
        f"{name}\t360\r\n" + "".join(f"{a}\t{cut[a]:.4f}\r\n" for a in range(-180, 180))
        for name, cut in (("vertical", vertical), ("horizontal", horizontal))
    )
    return f"name\tsector\r\ngain\t18.00 dBi\r\ncomment\tmeasured\r\n{body}"


def european() -> str:
    """Decimal commas, semicolons, half degrees with both ends of the turn."""
    horizontal, vertical = cuts()
    halves, body = np.arange(0, 360.5, 0.5), ""
    for name, cut in (("HORIZONTAL", horizontal), ("VERTICAL", vertical)):
        body += f"{name} {len(halves)}\n"
        for angle in halves:
            body += f"{angle:g};{np.interp(angle, ANGLES, cut, period=360):.4f}\n".replace(".", ",")
    return f"NAME sector\nGAIN 18,00dBi\n{body}"


@pytest.mark.parametrize("layout", [classic, tabbed, european])
def test_three_layouts_give_the_same_antenna(layout, tmp_path: Path) -> None:
    file = tmp_path / "sector.msi"
    file.write_text(layout(), newline="")
    horizontal, vertical = cuts()
    read = read_two_cuts(file)
    assert read.gain_dbi == pytest.approx(18.0)
    np.testing.assert_allclose(read.horizontal_db, horizontal, atol=1e-3)
    np.testing.assert_allclose(read.vertical_db, vertical, atol=1e-3)
    table = read_gain_table(file)
    # Clockwise in the file is negative azimuth; downwards in the file is negative elevation.
    azimuth = np.arange(-180.0, 180.0)
    in_front = table.gain(0.0, -6.0)
    assert in_front == pytest.approx(18.0, abs=0.01)
    assert table.gain(-15.0, 0.0) > table.gain(15.0, 0.0) + 2
    # On the horizon, the horizontal cut changed by the vertical one in front and behind.
    back = np.abs(azimuth) / 180
    expected = 18 - horizontal[(-azimuth).astype(int) % 360]
    expected -= (1 - back) * (vertical[0] - horizontal[0]) + back * (vertical[180] - horizontal[180])
    np.testing.assert_allclose(table.gain(azimuth, np.zeros(360)), expected, atol=0.01)
    np.testing.assert_allclose(table.gain(np.zeros(90), -np.arange(90.0)), 18 - vertical[:90], atol=0.01)


@pytest.mark.parametrize("unit", ["dBi", "(dBi)", "[dBI], peak", "in dBi"])
def test_a_gain_is_in_dbi_if_its_line_contains_dbi(unit: str, tmp_path: Path) -> None:
    for stated, gain in (
        (f"17.50 {unit}", 17.5),
        ("17.50 dBd (19.65 dBi)", 19.65),
        ("17.50 (dBd) 19.65 dBi", 19.65),
        ("17.50", 19.65),
    ):
        (tmp_path / "sector.msi").write_text(classic().replace("GAIN 15.85", f"GAIN {stated}"))
        assert read_two_cuts(tmp_path / "sector.msi").gain_dbi == pytest.approx(gain)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("GAIN 15.85", "GAIN none", r"line 3: GAIN 'none': must be a number"),
        ("GAIN 15.85", "GAIN 158.5", r"line 3: GAIN 160.65 must be -30 to 60; check the unit"),
        ("GAIN 15.85", "GAIN 0x1", r"line 3: GAIN '0x1': must be a number"),
        ("GAIN 15.85\n", "", r"no line GAIN; add"),
        ("HORIZONTAL 360", "HORIZONTAL", r"line 5: HORIZONTAL ''.*number of its lines"),
        ("\n7.0 0.", "\nseven 0.", r"line 13: 'seven 0.*must be an angle"),
        ("\n0.0 0.6391\n", "\n0.0 -20\n", r"line 6: attenuation -20 must be -0.5 to 100; attenuations are positive"),
        ("VERTICAL 360", "VERTICAL 400", r"VERTICAL states 400 lines, but the file ends after 360"),
        ("VERTICAL 360", "HORIZONTAL 360", r"line 366: HORIZONTAL is given twice"),
        ("HORIZONTAL 360", "HORIZONTAL \xb2", r"line 5: HORIZONTAL '.*number of its lines"),
        ("HORIZONTAL 360", "HORIZONTAL 359", r"line 365: '359.*belongs to no cut"),
        ("VERTICAL 360", "VERTICAL 30", r"VERTICAL has a gap of 331 degrees"),
    ],
)  # fmt: skip
def test_malformed_files_are_refused_with_line_and_remedy(
    old: str, new: str, message: str, tmp_path: Path
) -> None:
    file, text = tmp_path / "sector.msi", classic()
    assert old in text
    file.write_text(text.replace(old, new, 1), encoding="latin-1")
    with pytest.raises(InputError, match=message):
        read_two_cuts(file)
