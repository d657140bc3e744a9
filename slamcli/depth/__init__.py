"""Single depth images: their noise, their surfaces as oriented points, their depth at key points, and `icp`, which aligns two of them."""
