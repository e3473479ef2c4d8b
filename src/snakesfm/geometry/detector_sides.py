"""The sides to which images are scaled down for the detector; free of numpy, as the planner is."""

# what jobs are told of them
SHORTER_SIDE = "detector_shorter_side_px"
LONGER_SIDE = "detector_longer_side_px"
# the shorter side, unless an option tells another
USUAL_SIDE_PX = 760
# to which a matcher without keypoints leaves the shorter side of long images: LoFTR ignores a border
LEAST_SIDE_PX = 64
