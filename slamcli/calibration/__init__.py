"""What is not known of the camera: `self_calibration` finds it together with the map, `rolling_shutter` corrects measurements for it."""
