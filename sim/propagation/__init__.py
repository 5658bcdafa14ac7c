"""Pupil -> pixel energies.

pupil       the field behind the DOE, row block by row block
oblique     wave numbers of light to the pixels and from near sources
pixel       integration of a sampled intensity over square sensor pixels on its axes
edge_step   the weight of a sample near a pixel's edge, wherever that lies
mapped      the same integration for pixels at the places of a map
places      those maps: the lens's mapping and distortion, a sensor that is turned, stretched or bent
field_weights  the sensor's field between its samples
farfield    the default path (eqs. 7-9 of the paper)
hankel      the same for rotationally symmetric pupils
directions  the far field in single directions: spots and orders
near_axis   light near the axis at distances behind a DOE without a lens
fresnel     the direct path (eq. 5): reference for the other two
"""
