"""Pictures of what light does. Each function draws, returns what it drew on, and leaves writing to `fab.figure.save`.

colours  names and line colours of colour channels, positions of depths in a bank
psfs     point spread functions of every colour and depth
curves   MTF and encircled energy over colours and depths
leakage  a PSF as designed and as fabricated, and its leaked and diffracted light
places   places as lengths or as angles, on axes and in words
pattern  a target pattern beside the achieved one
"""
