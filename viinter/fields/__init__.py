"""The fields `F(xy | z) -> rgb`: one file for each."""
