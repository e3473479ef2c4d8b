"""A small known model, made by COLMAP."""

import pycolmap

SIZE = (1024, 768)


def synthesize_model():
    """Four images of one camera, ``SIZE`` pixels large, and 60 points."""
    pycolmap.logging.minloglevel = 2
    # whatever this process drew before
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 4
    options.num_points3D = 60
    return pycolmap.synthesize_dataset(options)
