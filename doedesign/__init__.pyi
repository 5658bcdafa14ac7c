from .build import camera_from_spec as camera_from_spec
from .build import process_from_spec as process_from_spec
from .calibration.estimate import Calibration as Calibration
from .calibration.estimate import calibrate as calibrate
from .calibration.explanations import ExplanationSet as ExplanationSet
from .calibration.explanations import Targets as Targets
from .calibration.explanations import explain_ratio as explain_ratio
from .capture.simulate import SimulatedCapture as SimulatedCapture
from .capture.simulate import simulate as simulate
from .design.design import Design as Design
from .optimization import optimize as optimize
from .prediction import predict as predict
from .recon.model import Model as Model
from .recon.reconstruction import Reconstruction as Reconstruction
from .runs.level_maps import open_design as open_design
from .spec import Spec as Spec
from .spec import load_spec as load_spec
from .tolerancing.results import ToleranceResult as ToleranceResult
from .tolerancing.results import tolerance as tolerance
from .tolerancing.studies import study as study
from .training.finetune import finetune as finetune
from .training.train import train as train

__version__: str
