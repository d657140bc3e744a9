"""One reach of the camera moves the ranges of all stages, and only those that nobody set."""

import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamcli.config import ranges, toml
from slamcli.config.options import Config

ALL = (*ranges.FARTHEST, *ranges.NEAREST)


def of(config: Config) -> dict[str, float]:
    return {name: toml._get(config, name) for name in ALL}


def test_the_defaults_are_what_the_default_reach_gives() -> None:
    reach = Config().sensor
    assert of(Config()) == {name: ranges.derived(name, reach.depth_min if name in ranges.NEAREST else reach.depth_max) for name in ALL}


@pytest.mark.parametrize(("reach", "octree", "cloud"), [(8.0, 3.2, 4.0), (3.0, 3.0, 3.0), (5.0, 3.2, 4.0), (16.0, 6.4, 8.0)])
def test_ranges_follow_the_reach(reach: float, octree: float, cloud: float) -> None:
    config = toml.apply(Config(), [f"sensor.depth_max={reach}"])
    assert (config.octree.max_range, config.densify.depth_max) == (octree, cloud)
    assert toml.apply(Config(), ["sensor.depth_min=0.1"]).grid2d.min_range == 0.1


@given(st.floats(0.5, 30), st.floats(0.5, 30))
def test_no_range_is_beyond_the_reach_and_back_is_back(a: float, b: float) -> None:
    once = toml.apply(Config(), [f"sensor.depth_max={a}"])
    assert all(value <= a + 1e-6 for name, value in of(once).items() if name in ranges.FARTHEST)
    again = toml.apply(once, [f"sensor.depth_max={b}"])
    assert of(again) == of(toml.apply(Config(), [f"sensor.depth_max={b}"]))
    assert toml.apply(again, ["sensor.depth_max=8"]) == Config()


def test_what_is_set_on_purpose_stays() -> None:
    for settings in (["octree.max_range=2.5", "sensor.depth_max=2.8"], ["sensor.depth_max=2.8", "octree.max_range=2.5"]):
        config = toml.apply(Config(), settings)
        assert (config.octree.max_range, config.grid2d.max_range) == (2.5, 2.8)
    one = toml.merge(Config(), {"sensor": {"depth_max": 2.8}, "octree": {"max_range": 3.2}}, source="file")
    assert (one.octree.max_range, one.ground.max_range) == (3.2, 2.8)


def test_a_written_configuration_is_read_back_as_it_is() -> None:
    config = toml.apply(Config(), ["sensor.depth_max=2.8", "octree.max_range=3.2"])
    assert toml.merge(Config(), tomllib.loads(toml.dump(config)), source="file") == config
