"""Other people's ways to learn the dynamics of a plant, each from its paper, to be measured beside ours."""
