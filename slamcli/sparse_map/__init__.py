"""The map of key frames and landmarks: `sparse_map` holds it, `guided_matching` finds its landmarks in a frame, `map_adjustment` adjusts it."""
