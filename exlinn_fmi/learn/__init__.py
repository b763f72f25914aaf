"""Learning 𝓛(q, q̇) and D(q̇) from data: objectives, training, identification, weights on disk."""
