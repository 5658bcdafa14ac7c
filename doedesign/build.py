"""From a spec to the values the physics works on. The only file that knows both."""

from doedesign.spec import Spec
from fab.grid import Grid
from fab.levels import Levels
from sim.camera import Camera, Colour


def camera_of(spec: Spec) -> Camera:
    """Lens, sensor, substrate and DOE grid of a spec."""
    return Camera(
        grid=Grid((spec.doe.samples, spec.doe.samples), spec.doe.pitch_m),
        # What the chrome leaves open, not what is etched: this is the circle light passes.
        aperture_m=spec.doe.aperture_m - 2 * spec.process.chrome_overlap_m,
        material=spec.doe.material,
        colours=tuple(Colour(c.name, c.wavelengths_m, c.weights) for c in spec.optics.colours),
        focal_length_m=spec.optics.focal_length_m,
        pixel_m=spec.sensor.pixel_m,
        window=spec.sensor.window,
        fill=spec.sensor.fill_factor,
        defocus_m=spec.sensor.defocus_m,
    )


def levels_of(spec: Spec) -> Levels:
    """The staircase of heights the process can make."""
    return Levels(spec.process.levels, spec.process.level_step_m)
