"""The names of the stages, in the order of the pipeline."""

STAGES: tuple[str, ...] = (
    "index_images",
    "extract_features",
    "learn_vocabulary",
    "describe_images",
    "select_pairs",
    "match_pairs",
    "merge_keypoints",
    "index_matches",
    "calibrate_cameras",
    "estimate_two_view",
    "build_view_graph",
    "filter_view_graph",
    "average_rotations",
    "build_tracks",
    "average_translations",
    "triangulate_tracks",
    "adjust_bundle",
    "export_database",
    "export_hloc",
    "export_model",
    "evaluate_model",
    "render_report",
)


def stages_between(first: str, last: str) -> tuple[str, ...]:
    """The stages from one to another, both included."""
    return STAGES[STAGES.index(first) : STAGES.index(last) + 1]
