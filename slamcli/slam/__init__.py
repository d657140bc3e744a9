"""SLAM: `tracker` says what happens to each frame, `localizer` finds its pose, `key_frames` decides, `map_growth` adds it to the map.

When all frames are in, `loop_closing` joins places seen again, and `final_refinement` looks at everything once more. Each of these calls
the other files here for one step. Beside them: what moves (`moving_objects`, `standing_objects`, `gone_objects`, `background_*`), where the
camera rests (`rests`), and how far results can be trusted (`*doubt`).
"""
