"""FMUs without Python inside, made from any plant or learned model."""
