"""Every number of the result files beside metrics.json; a name is that of its group (`doedesign.reference.numbers`)."""

from types import MappingProxyType

from doedesign.reference.numbers import NumberGroup, ResultNumber, sourced

_SHARE, _RATIO = ("share", "0 to 1"), ("1", "0 or more")

_STATISTICS = {
    "quantity": ResultNumber("text", "a number of a plate", "the number that a line is about", "sim.metrics.METRICS"),
    "mean": ResultNumber("of the number", "", "mean over the plates that the model describes", ""),
    "std": ResultNumber("of the number", "0 or more", "standard deviation over these plates", ""),
    "min": ResultNumber("of the number", "", "smallest of them", ""),
    "p05": ResultNumber("of the number", "", "5th percentile", ""),
    "median": ResultNumber("of the number", "", "median", ""),
    "p95": ResultNumber("of the number", "", "95th percentile", ""),
    "max": ResultNumber("of the number", "", "largest of them", ""),
    "count": ResultNumber("count", "1 or more", "Monte-Carlo draws", ""),
    "key": ResultNumber("text", "such as normal/17", "draw, for `psf --fabricated --draw`", "fab.draws"),
    "limit": ResultNumber("text", "such as strehl >= 0.6", "limit that a yield is of", ""),
    "good": ResultNumber("count", "0 or more", "plates that obey every limit", ""),
    "plates": ResultNumber("count", "0 or more", "plates that were looked at", ""),
    "share": ResultNumber(
        "share", "0 to 1", "yield: good / plates; a share of the variance of a number below `shares`", ""
    ),
    "low": ResultNumber(
        "of the number",
        "",
        "of a yield or an index, lower end of its 95 % interval; of an error alone, the number one "
        "standard deviation below the mean, null where it strays to one side only; of a budget, the factor "
        "that holds the "
        "wanted yield with 97.5 % confidence",
        "",
    ),
    "high": ResultNumber("of the number", "", "the upper end, or the number one standard deviation above the mean", ""),
    "error": ResultNumber("text", "such as overlay_x_m[0]", "error that was changed alone", "fab.process.DEVIATIONS"),
    "source": ResultNumber("text", "such as overlay", "group of errors", "fab.process.DEVIATIONS"),
    "expected": ResultNumber("of the number", "", "the number with every error at its mean", ""),
    "variance": ResultNumber("of the number, squared", "0 or more", "variance that an error adds by itself", ""),
    "first": ResultNumber(
        "share", "0 to 1, but for sampling", "Sobol index: share of the variance by a source alone", ""
    ),
    "total": ResultNumber("share", "0 to 1, but for sampling", "Sobol index: the same together with all others", ""),
    "value": ResultNumber("share", "0 to 1, but for sampling", "estimate of an index", ""),
    "what": ResultNumber(
        "text", "a source or an error", "errors that a budget is for", "doedesign.tolerancing.budget.Budget"
    ),
    "wanted": ResultNumber("share", "0 to 1", "yield that a budget is for", "doedesign.tolerancing.budget.Budget"),
    "factors": ResultNumber("1", "0 or more", "factors by which the standard deviations were multiplied", ""),
    "factor": ResultNumber("1", "0 or more", "factor that gives the wanted yield", ""),
    "verdict": ResultNumber("text", "found, beyond, out of reach", "whether there is such a factor", ""),
    "sigmas": ResultNumber("SI", "0 or more", "standard deviations at the factor, by error", ""),
    "seed": ResultNumber("count", "0 or more", "seed of all draws", ""),
}
_SCORES = {
    "psnr": ResultNumber(
        "dB", "0 or more; null for equal pictures", "10 log10(1 / mean squared error) of display values", ""
    ),
    "ssim": ResultNumber("1", "-1 to 1", "structural similarity, Gaussian windows of sigma 1.5", ""),
    "closeness": ResultNumber("1", "at most 1", "1 - LPIPS; only where its weights are there", ""),
    "covered": ResultNumber("share", "0 to 1", "mean of the mask of a scene", ""),
}
_CERTIFICATE = {
    "zeroth_order_scalar": ResultNumber(*_SHARE, "0th order of the whole design as a thin element", ""),
    "zeroth_order_edges": ResultNumber(*_SHARE, "the same with the light of walls", ""),
    "scalar": ResultNumber(*_SHARE, "0th order, or efficiency of an order, of a cut-out as a thin element", ""),
    "edges": ResultNumber(*_SHARE, "the same with the light of walls", ""),
    "rigorous": ResultNumber(*_SHARE, "the same by Maxwell's equations", ""),
    "error_scalar": ResultNumber(
        *_RATIO,
        "root sum of squares of the amplitudes that miss those of the rigorous solution, relative, as a thin element",
        "",
    ),
    "error_edges": ResultNumber(*_RATIO, "the same with the light of walls", ""),
    "unsettled": ResultNumber(*_RATIO, "relative change of the rigorous solution with more terms", ""),
    "energy": ResultNumber("1", "about 1", "energy of the rigorous solution over that of the light", ""),
    "ring_to_disc_scalar": ResultNumber("1", "0 or more", "ring_to_disc as a thin element", ""),
    "ring_to_disc_edges": ResultNumber("1", "0 or more", "ring_to_disc with the light of walls", ""),
    "difference": ResultNumber(
        *_RATIO, "relative difference of the PSFs with and without walls, root sum of squares", ""
    ),
    "order": ResultNumber("count", "any", "diffraction order that is compared", ""),
    "axis": ResultNumber("text", "x or y", "axis along which a row runs", ""),
    "polarisation": ResultNumber("text", "x or y", "axis of the electric field", ""),
    "centre_x_m": ResultNumber("m", "any", "place of a cut-out on the DOE, along x", ""),
    "centre_y_m": ResultNumber("m", "any", "the same along y", ""),
    "height_m": ResultNumber("m", "0 or more", "highest wall of a cut-out", ""),
    "wavelength_m": ResultNumber("m", "above 0", "vacuum wavelength", ""),
}
_COLUMNS = {
    "order_x": ResultNumber("count", "any", "diffraction order along x; empty where spots are none", "orders.csv"),
    "order_y": ResultNumber("count", "any", "the same along y", "orders.csv"),
    "x_mm": ResultNumber(
        "mm", "any", "place of a spot on the sensor along x; x_deg, an angle, without one", "orders.csv"
    ),
    "y_mm": ResultNumber("mm", "any", "the same along y; y_deg without a sensor", "orders.csv"),
    "efficiency": ResultNumber(
        *_SHARE, "share of the light in a spot, without the loss at the glass faces", "orders.csv"
    ),
    "over_wanted": ResultNumber(
        *_RATIO, "light of a spot over the share of on_target that it should have", "orders.csv"
    ),
    "phase_error_deg": ResultNumber(
        "deg", "-180 to 180", "phase of a spot less the one given, after the best common one", "orders.csv"
    ),
    "area": ResultNumber("count", "1 or more", "number of the area, of several", "area.csv"),
    "axis": ResultNumber("text", "x or y", "axis of a profile", "area.csv"),
    "place_mm": ResultNumber(
        "mm", "any", "place on the profile, from the middle of the area; place_deg without a sensor", "area.csv"
    ),
    "light": ResultNumber(*_RATIO, "light there over the mean of the flat part", "area.csv"),
    "wanted": ResultNumber(*_RATIO, "light that is wanted there, likewise", "area.csv"),
    "distance_mm": ResultNumber("mm", "above 0", "distance of a focus", "focus.csv"),
    "wanted_um": ResultNumber("um", "above 0", "width wanted (width_wanted_m)", "focus.csv"),
    "width_y_um": ResultNumber("um", "above 0", "width along y (width_y_m)", "focus.csv"),
    "width_x_um": ResultNumber("um", "above 0", "width along x (width_x_m)", "focus.csv"),
}

_EVALUATION = {
    "row": ResultNumber("text", "a method", "row of the table: network, camera, plate or program", ""),
    "region": ResultNumber("text", "occluded or full", "region of the picture", ""),
    "score": ResultNumber("text", "ssim, psnr, closeness", "score that a line is of", ""),
    "mean": ResultNumber("of the score", "", "mean over the test pairs", ""),
    "low": ResultNumber("of the score", "", "lower end of its 95 % bootstrap interval over photographs and seeds", ""),
    "high": ResultNumber("of the score", "", "upper end", ""),
    "pairs": ResultNumber("count", "1 or more", "test pairs that have this score, a finite one", ""),
    "pictures": ResultNumber("count", "1 or more", "photographs that they are made of", ""),
    "seeds": ResultNumber("count", "0 or more", "trainings that the row is a mean of", ""),
    "gain": ResultNumber("of the score", "", "mean difference to the proposed row, pair by pair", ""),
    "gain_low": ResultNumber("of the score", "", "lower end of its interval", ""),
    "gain_high": ResultNumber("of the score", "", "upper end", ""),
    "paper": ResultNumber("of the score", "", "number that the paper prints for this row", ""),
    "parameters": ResultNumber("count", "0 or more", "weights of the network", ""),
    "original_parameters": ResultNumber(
        "count", "0 or more", "weights of the original, of a network after a published idea", ""
    ),
    "run": ResultNumber(
        "count",
        "1 or more",
        "1; 2 and more for rows of later runs that were joined to a table: their gain is to that run's own proposed "
        "row, whose mean is `mean` less `gain`",
        "",
    ),
    "why_not": ResultNumber("text", "a sentence", "why a row could not be computed", ""),
    "pair": ResultNumber("count", "0 or more", "number of a test pair (pairs.csv)", ""),
    "picture": ResultNumber("text", "a file", "its photograph (pairs.csv)", ""),
    "far_m": ResultNumber("m", "above 0", "distance of its scene (pairs.csv)", ""),
    "near_m": ResultNumber("m", "above 0", "distance of its obstruction (pairs.csv)", ""),
    "covered": ResultNumber("share", "0 to 1", "share of pixels in the occluded region (pairs.csv)", ""),
}
_FIGURES = {
    "plate": ResultNumber("text", "drawn, fabricated, or a classic plate", "plate that a row is of", ""),
    "inside": ResultNumber(*_SHARE, "light inside the geometric defocus disc of the depth (depths.csv)", ""),
    "throughput_near": ResultNumber(*_SHARE, "throughput from the nearest depth (plates.csv)", ""),
    "throughput_far": ResultNumber(*_SHARE, "throughput from the farthest depth (plates.csv)", ""),
    "mtf_near_quarter": ResultNumber(
        *_SHARE, "near modulation transfer at a quarter of the sensor's Nyquist frequency", ""
    ),
    "mtf_near_half": ResultNumber(*_SHARE, "the same at half of it", ""),
    "mtf_near_nyquist": ResultNumber(*_SHARE, "the same at the Nyquist frequency", ""),
    "mtf_far_quarter": ResultNumber(
        *_SHARE, "far modulation transfer at a quarter of the sensor's Nyquist frequency", ""
    ),
    "mtf_far_half": ResultNumber(*_SHARE, "the same at half of it", ""),
    "mtf_far_nyquist": ResultNumber(*_SHARE, "the same at the Nyquist frequency", ""),
    "name": ResultNumber("text", "an image", "image of the bench (images.csv)", ""),
    "source_m": ResultNumber(
        "m", "above 0", "true distance of the source, depth_m being the one stated (images.csv)", ""
    ),
    "shortest_s": ResultNumber("s", "above 0", "shortest exposure (images.csv)", ""),
    "longest_s": ResultNumber("s", "above 0", "longest exposure (images.csv)", ""),
    "rim": ResultNumber(*_SHARE, "irradiance at the rim of the aperture over that in the middle (images.csv)", ""),
    "relay": ResultNumber(*_SHARE, "light in the frame that the relay lets pass (images.csv)", ""),
    "in_frame": ResultNumber(*_SHARE, "light that falls on the frame of the bench's camera (images.csv)", ""),
    "peak": ResultNumber(*_SHARE, "light on the brightest pixel (images.csv)", ""),
    "full_px": ResultNumber("count", "0 or more", "pixels that are full in the longest exposure (images.csv)", ""),
}

_SIGMA = ResultNumber("of the value", "above 0", "standard deviation of `value` after the measurement", "")
_CALIBRATION = {
    "name": ResultNumber("text", "", "error of the plate, quantity of the camera, or image", ""),
    "value": ResultNumber("SI unit of the name", "any", "estimate", ""),
    "sigma": _SIGMA,
    "prior_mean": ResultNumber("of the value", "any", "what the process, or the bench, was expected to have", ""),
    "prior_sigma": ResultNumber("of the value", "0 or more", "standard deviation of that; 0 where it is known", ""),
    "assumed": ResultNumber("true or false", "", "whether the process is silent on it and a usual one was taken", ""),
    "determined": ResultNumber("true or false", "", "whether the images tell much more of it than was known", ""),
    "correlation": ResultNumber("1", "-1 to 1", "matrix of correlations: errors, then the camera", ""),
    "chi2_per_pixel": ResultNumber(
        "1", "0 or more", "mean of (measured - fitted)² over the variance of the noise; noise alone gives 1", ""
    ),
    "inflation": ResultNumber("1", "1 or more", "factor of all standard deviations for what the model misses", ""),
    "explained": ResultNumber("true or false", "", "whether the model explains the images", ""),
    "depth_m": ResultNumber("m", "above 0; null for infinity", "fitted distance of the source of an image", ""),
    "pixels": ResultNumber("count", "1 or more", "pixels of an image that were compared", ""),
    "rate_per_unit_energy": ResultNumber(
        "counts per second", "above 0", "of a pixel that all light of the clear aperture would fall on", ""
    ),
    "background": ResultNumber("counts per second", "any", "of every pixel of an image, beside the light", ""),
    "shift_px": ResultNumber("pixels", "any", "fitted moves of an image along y and x", ""),
    "defocus_per_m": ResultNumber("1/m", "any", "fitted change of the curvature of the wave of an image", ""),
    "chi2_per_pixel_from_the_others": ResultNumber(
        "1", "0 or more", "the same of an image that took no part, predicted from the others", ""
    ),
    "image": ResultNumber("text", "", "image that a reading is of", ""),
    "quantity": ResultNumber("text", "a number of a plate", "number that was read off", "sim.metrics.METRICS"),
    "measured": ResultNumber(
        "of the number", "", "read off the image, with its standard deviation; null where it cannot be", ""
    ),
    "predicted": ResultNumber("of the number", "", "of the fitted model, likewise", ""),
    "rises": ResultNumber(
        "1", "about 1", "rise of the cost one standard deviation away, along the least known directions", ""
    ),
    "models": ResultNumber("count", "1 or more", "plates as fabricated that were computed", ""),
    "remarks": ResultNumber("text", "sentences", "what a reader should know of the fit", ""),
}
_EXPLANATIONS = {
    "values": ResultNumber("SI units", "any", "errors by name that give the measured ratio", ""),
    "scores": ResultNumber("1", "any", "the same in standard deviations from the means of the process", ""),
    "distance": ResultNumber("1", "0 or more", "root of the sum of squares of scores; the least is most plausible", ""),
    "fits": ResultNumber(
        "true or false", "", "whether the throughput is within two standard deviations of the measured one", ""
    ),
    "throughput_sigma": ResultNumber("share", "0 or more", "standard deviation of the measured throughput", ""),
    "none": ResultNumber("text", "", "errors, or pairs of them, that do not reach the ratio", ""),
    "reach": ResultNumber("1", "above 0", "standard deviations up to which was looked", ""),
}

OTHER_GROUPS: tuple[NumberGroup, ...] = (
    NumberGroup(
        "Columns of tables",
        "orders.csv, area.csv, focus.csv; columns with a name of metrics.json are the same numbers",
        MappingProxyType(_COLUMNS),
    ),
    NumberGroup(
        "Tolerance studies",
        "results.json of `tolerance/`, tolerance.json of a released design",
        MappingProxyType(sourced(_STATISTICS, "doedesign.tolerancing")),
    ),
    NumberGroup(
        "Certificates", "certificate.json", MappingProxyType(sourced(_CERTIFICATE, "doedesign.runs.certificate"))
    ),
    NumberGroup(
        "Scores of pictures",
        "metrics.json of `trained/` and `finetuned/`, tables of `evaluate`: in the region `occluded` "
        "(mask at least one half) and in the `full` picture, of the `capture`, its `reconstruction` and others",
        MappingProxyType(sourced(_SCORES, "doedesign.training.scores")),
    ),
    NumberGroup(
        "Evaluation tables",
        "table.csv, table.json and pairs.csv of `evaluation/table*`",
        MappingProxyType(sourced(_EVALUATION, "doedesign.evaluation.tables")),
    ),
    NumberGroup(
        "Figures of optics",
        "plates.csv, depths.csv and images.csv of `evaluation/figure4`, `figure8` and `bench`; columns with a name of "
        "metrics.json are the same numbers",
        MappingProxyType(sourced(_FIGURES, "doedesign.evaluation.optics")),
    ),
    NumberGroup(
        "Calibrations",
        "calibration.json; names of errors are those of `fab.process.DEVIATIONS`",
        MappingProxyType(sourced(_CALIBRATION, "doedesign.calibration")),
    ),
    NumberGroup(
        "Explanations of a measured ratio",
        "explanations.json, beside numbers of metrics.json",
        MappingProxyType(sourced(_EXPLANATIONS, "doedesign.calibration.explanations")),
    ),
)
