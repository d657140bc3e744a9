"""Figures that others published, for comparison; none was measured here."""

# APE RMSE [m], SE(3), no scale: Zhao et al. 2020, Table 4, of their own system, ORB-SLAM2 and RGB-D SLAM v2
COLUMNS = ("Zhao et al. 2020, published", "ORB-SLAM2, published there", "RGB-D SLAM v2, published there")
APE = {
    "fr1_desk2": (0.022186, 0.023211, 0.058751),
    "fr1_xyz": (0.009708, 0.010084, 0.019186),
    "fr1_room": (0.044592, 0.077027, 0.177780),
}
# [MB], of the dense cloud and of the octree: Zhao et al. 2020, Table 5, which does not name the file formats
SIZES = {"fr1_desk2": (31.3, 0.818), "fr1_xyz": (7.7, 0.216), "fr1_room": (84.2, 2.932)}
SIZE_COLUMN = "octree / cloud, Zhao et al., published"


def sequence(recording: str) -> str:
    """Return the short name of a sequence, fr1_xyz, of whichever name a recording goes by."""
    return recording.split("/")[-1].replace("rgbd_dataset_freiburg", "fr")


def ape(recording: str) -> list[str]:
    """Return the cells of COLUMNS."""
    return [f"{value:.4f}" for value in APE[sequence(recording)]] if sequence(recording) in APE else [""] * len(COLUMNS)


def size_share(recording: str) -> str:
    """Return the cell of SIZE_COLUMN."""
    if sequence(recording) not in SIZES:
        return ""
    cloud, octree = SIZES[sequence(recording)]
    return f"{100 * octree / cloud:.2f} %"
