"""Test that agents have different colours, and that labels on these colours are readable."""

from harness.present.colours import contrast, inks


def test_thirty_two_agents_have_different_inks() -> None:
    assert len(set(inks(range(1, 33)).values())) == 32


def test_labels_are_readable_on_every_ink() -> None:
    for ink in inks(range(1, 65)).values():
        assert contrast(ink.fill, ink.text) >= 4.5


def test_every_box_stands_out_from_a_light_and_a_dark_page() -> None:
    for ink in inks(range(1, 65)).values():
        for page in ("#ffffff", "#14171a"):
            assert max(contrast(ink.fill, page), contrast(ink.stroke, page)) >= 2.4


def test_colours_depend_on_the_set_of_agents_and_not_on_their_order() -> None:
    assert inks([3, 1, 2]) == inks([1, 2, 3, 3])
