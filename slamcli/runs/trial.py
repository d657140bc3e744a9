"""A trial map: what it says of the depth camera with which depth was registered on reading."""

from slamcli.calibration import registration
from slamcli.calibration.self_calibration import Sensing
from slamcli.config.options import Config
from slamcli.datasets import Dataset
from slamcli.errors import SlamError
from slamcli.estimation.shared_parameters import SharedEvidence
from slamcli.files import scratch
from slamcli.geometry.depth_registration import Registration
from slamcli.runs.pipeline import Pipeline
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Features, Map, Timing
from slamcli.sparse_map.sparse_map import SparseMap
from slamcli.stages import measurements


def registration_evidence(recording: Dataset, config: Config, given: Registration) -> SharedEvidence | None:
    """Map a recording in a folder that is removed again, and ask that map about the registration `given` with which its depth was read.

    None where no map came about.
    """
    with scratch("slamcli-trial-") as folder:
        run = RunDir.create(folder / "run", dataset=recording.name, root=str(recording.root.resolve()), digest=recording.digest())
        run.write_config(config)
        try:
            Pipeline(run, config, dataset=recording).bring_up_to_date(until="optimize")
        except SlamError:  # the run itself will say it
            return None
        map_, camera = run.load(Map, "optimize"), run.camera()
        now = Sensing(run.camera("optimize"), run.load(Timing, "optimize"), {})
        features = measurements.corrected(run, run.load(Features, "extract"), camera, now)
        return registration.evidence(SparseMap.from_map(features, map_), now, config.sensor, given)
