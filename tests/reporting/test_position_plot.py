"""The plan of a scene with the antennas."""

from calibray.reporting.link_map import draw_positions
from calibray.scenes.authoring import make_scene
from planted_maps import L_SHAPE, footprints


def test_a_plan_shows_the_antennas_and_the_footprints(tmp_path):
    made = make_scene(footprints([L_SHAPE], [10.0]), tmp_path)
    figure = draw_positions(made.path, [[0, 0, 10]], [[5, 5, 1.5], [40, 5, 1.5]])
    (axes,) = figure.axes
    labels = {text.get_text() for text in axes.get_legend().get_texts()}
    assert labels == {"2 receivers", "1 transmitter"}
    # Two collections of antennas, one of roofs and one of walls; the ground is left out.
    assert len(axes.collections) == 4
    figure.savefig(tmp_path / "map.svg")
    figure.savefig(tmp_path / "map.png")
    assert (tmp_path / "map.svg").read_text().startswith("<?xml")
