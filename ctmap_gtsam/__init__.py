"""CT-Map on GTSAM."""
