"""Single images and pairs of them: `orb` extracts features, `hamming` matches them, `vocabulary` and `bag_of_words` tell places apart."""
