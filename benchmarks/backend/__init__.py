"""The back-end alone, on view graphs with known truth and known outliers, against COLMAP's."""
