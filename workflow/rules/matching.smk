# Matches and relative poses of the pairs, one job per tile.


rule match_pairs:
    input:
        pairs=artifact("select_pairs", "{tile}.h5"),
        features=tile_features,
    output:
        artifact("match_pairs", "{tile}.h5"),
    log:
        log_file("match_pairs", "{tile}"),
    benchmark:
        benchmark_file("match_pairs", "{tile}")
    resources:
        gpu=gpus("match_pairs"),
    params:
        job=job_params("match_pairs"),
        files=job_files(),
    shell:
        job_command("match_pairs")


rule calibrate_cameras:
    input:
        index=artifact("index_images", "index.h5"),
        features=files_of("extract_features", "blocks"),
        matches=files_of("match_pairs", "tiles"),
    output:
        artifact("calibrate_cameras", "cameras.h5"),
    log:
        log_file("calibrate_cameras"),
    benchmark:
        benchmark_file("calibrate_cameras")
    # pairs are worked on side by side
    threads: 2
    params:
        job=job_params("calibrate_cameras"),
        files=job_files(),
    shell:
        job_command("calibrate_cameras")


rule estimate_two_view:
    input:
        index=artifact("index_images", "index.h5"),
        cameras=artifact("calibrate_cameras", "cameras.h5"),
        features=tile_features,
        matches=artifact("match_pairs", "{tile}.h5"),
    output:
        artifact("estimate_two_view", "{tile}.h5"),
    log:
        log_file("estimate_two_view", "{tile}"),
    benchmark:
        benchmark_file("estimate_two_view", "{tile}")
    params:
        job=job_params("estimate_two_view"),
        files=job_files(),
    shell:
        job_command("estimate_two_view")
