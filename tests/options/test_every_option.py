"""What no test shows is no option: each occurs in a test that is marked `shows` and demands its effect.

    pytest -n 0 -m shows --disconnected

runs each of these tests once more for each option that it shows, with that option held at its default: it must fail.
"""

import option_marks as options

from slamcli.config.options import GridConfig


def test_every_option_has_a_test_that_shows_its_effect() -> None:
    marked = {name for name, _, _ in options.shown()}
    assert marked == set(options.names()), "mark a test that shows the effect: @pytest.mark.shows('section.option')"


def test_what_shows_an_option_names_it() -> None:
    silent = [f"{test}: {name}" for name, test, text in options.shown() if not options.mentions(text, name)]
    assert silent == []


def test_a_disconnected_option_is_missed_by_a_test_that_shows_it_and_by_no_other() -> None:
    def shows() -> None:
        assert GridConfig(resolution=0.2).resolution == 0.2

    def does_not() -> None:
        assert GridConfig(resolution=0.2).stride == GridConfig().stride

    assert options.is_missed("grid2d.resolution", shows) and not options.is_missed("grid2d.resolution", does_not)
    assert GridConfig(resolution=0.2).resolution == 0.2
