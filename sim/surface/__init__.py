"""The DOE that comes back from the cleanroom, as light sees it. The only model of the process.

`as_fabricated` takes a level map, a process and the errors of one plate (`fab.process.Variation`) and returns the
transmission of every DOE cell. Nothing is oversampled: displaced and widened masks cut each cell into a few pieces of
constant depth whose light is added exactly, rounded corners and tilted walls add what they change at the vertices and
along the lines between the pieces, and slow errors (uniformity, rotation, magnification) are constants of tiles of
32 x 32 cells. Everything is differentiable in every floating-point error, except where edges of two masks coincide
(there the light itself has a kink) and, for rounded corners, where the edge of another mask passes the corner (a jump
of a small part of a small term).

* depth, missed and doubled etches, uniformity: the depth a mask takes away; the bottom profile follows the top's.
* overlay, rotation, magnification, line width: where the masks' edges lie. A mask pixel narrower than twice a negative
  bias is lost, a gap narrower than twice a positive one closes.
* corner rounding: (1 - pi/4) r^2 of area at every corner of an opening or an island; two openings that touch at a
  corner neither merge nor part.
* side walls: floors are narrower than the drawn opening by depth x tan(angle) at each wall, depth falls linearly.
* etch lag: an opening of width w, the shorter of its runs along x and y, loses the share lag x depth / w of its depth.
* light of walls, where the camera's light has edges: a line of light along the wall of every mask, wherever it lies.
* roughness: a random height for every cell with the given rms and correlation length; what varies within a cell is
  light lost to angles beyond the sensor, exp(-variance / 2) of the amplitude.
* particles keep an etch off the mask's pixels whose centres they cover. Chrome: the opening's circle, which
  cuts cells as masks do where edges moved, and pinholes.

Reading order: `cell` (where lines cut a cell, and what a lens sees of its pieces), `roughness`, `relief` (the errors as
numbers), `pieces` (what is open where, and its light), `edges` (tilted walls and corners), `lines` (the light of
walls), `opening` (the rim of the chrome), `tile_light` (one tile), `tiles` (the whole plate), `plate` (the way in),
`leakage` (where its light goes).
"""

from sim.surface.plate import FabricatedDoe, as_fabricated, drawn_alike

__all__ = ["FabricatedDoe", "as_fabricated", "drawn_alike"]
