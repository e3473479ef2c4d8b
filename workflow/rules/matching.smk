# Matches and relative poses of the pairs, one job per tile.


rule match_pairs:
    input:
        pairs=artifact("select_pairs", "{tile}.h5"),
        features=of_scene(rule_inputs.matched_features, "tile"),
        index=of_scene(rule_inputs.matched_images),
    output:
        artifact("match_pairs", "{tile}.h5"),
    log:
        log_file("match_pairs", "{tile}"),
    resources:
        gpu=gpus("match_pairs"),
        mem_mb=memory_mb("match_pairs"),
        runtime=runtime_min("match_pairs"),
    params:
        job=job_params("match_pairs"),
        files=job_files(),
    shell:
        job_command("match_pairs")


rule merge_keypoints:
    input:
        index=artifact("index_images", "index.h5"),
        matches=of_scene(rule_inputs.block_tiles, "block"),
    output:
        artifact("merge_keypoints", "{block}.h5"),
    log:
        log_file("merge_keypoints", "{block}"),
    resources:
        mem_mb=memory_mb("merge_keypoints"),
        runtime=runtime_min("merge_keypoints"),
    params:
        job=job_params("merge_keypoints"),
        files=job_files(),
    shell:
        job_command("merge_keypoints")


rule index_matches:
    input:
        matches=artifact("match_pairs", "{tile}.h5"),
        features=of_scene(rule_inputs.tile_features, "tile"),
    output:
        artifact("index_matches", "{tile}.h5"),
    log:
        log_file("index_matches", "{tile}"),
    resources:
        mem_mb=memory_mb("index_matches"),
        runtime=runtime_min("index_matches"),
    params:
        job=job_params("index_matches"),
        files=job_files(),
    shell:
        job_command("index_matches")


rule calibrate_cameras:
    input:
        index=artifact("index_images", "index.h5"),
        features=of_scene(rule_inputs.keypoint_files),
        matches=of_scene(rule_inputs.match_files),
    output:
        artifact("calibrate_cameras", "cameras.h5"),
    log:
        log_file("calibrate_cameras"),
    # pairs are worked on side by side
    threads: 2
    resources:
        mem_mb=memory_mb("calibrate_cameras"),
        runtime=runtime_min("calibrate_cameras"),
    params:
        job=job_params("calibrate_cameras"),
        files=job_files(),
    shell:
        job_command("calibrate_cameras")


rule estimate_two_view:
    input:
        index=artifact("index_images", "index.h5"),
        cameras=artifact("calibrate_cameras", "cameras.h5"),
        features=of_scene(rule_inputs.tile_features, "tile"),
        matches=of_scene(rule_inputs.tile_matches, "tile"),
    output:
        artifact("estimate_two_view", "{tile}.h5"),
    log:
        log_file("estimate_two_view", "{tile}"),
    resources:
        mem_mb=memory_mb("estimate_two_view"),
        runtime=runtime_min("estimate_two_view"),
    params:
        job=job_params("estimate_two_view"),
        files=job_files(),
    shell:
        job_command("estimate_two_view")
