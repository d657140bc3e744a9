"""The stage track where something turns out to move once the camera's path is known."""

import numpy as np
import pytest
from scene_run import Run
from scenes import CAMERA, observe, room_points, sweep

from slamcli.schema import Moving, frame_poses
from slamcli.slam import moving_objects
from slamcli.stages import optimize, track
from slamcli.stages.moving_parts import NOTHING

FRAMES = 60
HIDDEN = slice(24, 36)  # frames of whose view the left part is found to move


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    rng, side = np.random.default_rng(3), moving_objects._side(CAMERA)
    moving = np.zeros((FRAMES, CAMERA.height // side, CAMERA.width // side), dtype=bool)
    moving[HIDDEN, :, : moving.shape[2] // 3] = True
    run = Run(observe(sweep(FRAMES, length=1.0), room_points(3000, rng), rng), tmp_path_factory.mktemp("run"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(track.moving_parts, "are_any", lambda *given: True)
        patch.setattr(track.moving_parts, "find", lambda *given: Moving(moving))
        patch.setattr(track, "_find_background", lambda *given: (NOTHING, None))
        run.stage(track)
        run.stage(optimize)
    return run


def test_no_landmark_rests_on_what_turned_out_to_move(run: Run) -> None:
    features, (_, map_) = run.scene.features, run.result("track")
    is_hidden = moving_objects.is_hidden(moving_objects.hide_features(features, run.load(Moving, "track").moving, CAMERA))
    frame = np.repeat(np.arange(FRAMES), np.diff(features.offset))
    assert is_hidden.sum() > 500 and set(frame[is_hidden]) == set(range(FRAMES)[HIDDEN])
    assert len(map_.obs_row) > 500 and not is_hidden[map_.obs_row].any()
    assert set(range(FRAMES)[HIDDEN]) & set(map_.kf_frame.tolist())  # some of what was removed was seen by key frames


def test_the_map_is_not_drawn_to_where_hidden_features_were_put(run: Run) -> None:
    for stage in ("track", "optimize"):
        T_wc = frame_poses(*run.result(stage))
        true = np.linalg.inv(run.scene.T_gc[0]) @ run.scene.T_gc
        assert 1e-5 < np.abs(T_wc[:, :3, 3] - true[:, :3, 3]).max() < 0.03, stage
    assert run.summary["optimize"]["cost"][0] < 10 * run.summary["optimize"]["cost"][-1]
