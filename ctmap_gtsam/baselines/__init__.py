"""What the estimators are held to: registration of single frames, and maps that stand still.

`registration` places a class in a crop of one depth image by ICP or by FPFH (Open3D); `detected` does that with the
detector's boxes, `oracle` with the true ones. `copying` copies a method's last map of each visit back into all of it,
`fusion` fuses all that a visit has seen of an object into one pose. `cameras` tells how well the cameras can be known
by one who knows the objects. `oracle` and `cameras` alone read the truth.
"""
