# From relative poses to the adjusted model, one job per stage.


rule build_view_graph:
    input:
        index=artifact("index_images", "index.h5"),
        geometries=files_of("estimate_two_view", "tiles"),
    output:
        artifact("build_view_graph", "graph.h5"),
    log:
        log_file("build_view_graph"),
    resources:
        mem_mb=memory_mb("build_view_graph"),
        runtime=runtime_min("build_view_graph"),
    params:
        job=job_params("build_view_graph"),
        files=job_files(),
    shell:
        job_command("build_view_graph")


rule filter_view_graph:
    input:
        index=artifact("index_images", "index.h5"),
        graph=artifact("build_view_graph", "graph.h5"),
    output:
        artifact("filter_view_graph", "graph.h5"),
    log:
        log_file("filter_view_graph"),
    resources:
        mem_mb=memory_mb("filter_view_graph"),
        runtime=runtime_min("filter_view_graph"),
    params:
        job=job_params("filter_view_graph"),
        files=job_files(),
    shell:
        job_command("filter_view_graph")


rule average_rotations:
    input:
        index=artifact("index_images", "index.h5"),
        graph=artifact("filter_view_graph", "graph.h5"),
    output:
        artifact("average_rotations", "rotations.h5"),
    log:
        log_file("average_rotations"),
    resources:
        mem_mb=memory_mb("average_rotations"),
        runtime=runtime_min("average_rotations"),
    params:
        job=job_params("average_rotations"),
        files=job_files(),
    shell:
        job_command("average_rotations")


rule build_tracks:
    input:
        index=artifact("index_images", "index.h5"),
        features=of_scene(rule_inputs.keypoint_files),
        coordinates=of_scene(rule_inputs.coordinate_files),
        geometries=files_of("estimate_two_view", "tiles"),
        graph=artifact("filter_view_graph", "graph.h5"),
        rotations=artifact("average_rotations", "rotations.h5"),
    output:
        artifact("build_tracks", "tracks.h5"),
    log:
        log_file("build_tracks"),
    resources:
        mem_mb=memory_mb("build_tracks"),
        runtime=runtime_min("build_tracks"),
    params:
        job=job_params("build_tracks"),
        files=job_files(),
    shell:
        job_command("build_tracks")


rule average_translations:
    input:
        index=artifact("index_images", "index.h5"),
        cameras=artifact("calibrate_cameras", "cameras.h5"),
        graph=artifact("filter_view_graph", "graph.h5"),
        rotations=artifact("average_rotations", "rotations.h5"),
        tracks=artifact("build_tracks", "tracks.h5"),
    output:
        artifact("average_translations", "centers.h5"),
    log:
        log_file("average_translations"),
    resources:
        mem_mb=memory_mb("average_translations"),
        runtime=runtime_min("average_translations"),
    params:
        job=job_params("average_translations"),
        files=job_files(),
    shell:
        job_command("average_translations")


rule triangulate_tracks:
    input:
        index=artifact("index_images", "index.h5"),
        cameras=artifact("calibrate_cameras", "cameras.h5"),
        rotations=artifact("average_rotations", "rotations.h5"),
        centers=artifact("average_translations", "centers.h5"),
        tracks=artifact("build_tracks", "tracks.h5"),
    output:
        artifact("triangulate_tracks", "points.h5"),
    log:
        log_file("triangulate_tracks"),
    resources:
        mem_mb=memory_mb("triangulate_tracks"),
        runtime=runtime_min("triangulate_tracks"),
    params:
        job=job_params("triangulate_tracks"),
        files=job_files(),
    shell:
        job_command("triangulate_tracks")


rule adjust_bundle:
    input:
        index=artifact("index_images", "index.h5"),
        cameras=artifact("calibrate_cameras", "cameras.h5"),
        features=of_scene(rule_inputs.keypoint_files),
        geometries=files_of("estimate_two_view", "tiles"),
        graph=artifact("filter_view_graph", "graph.h5"),
        rotations=artifact("average_rotations", "rotations.h5"),
        centers=artifact("average_translations", "centers.h5"),
        points=artifact("triangulate_tracks", "points.h5"),
    output:
        artifact("adjust_bundle", "reconstruction.h5"),
    log:
        log_file("adjust_bundle"),
    # keypoints are refined side by side
    threads: 2
    resources:
        mem_mb=memory_mb("adjust_bundle"),
        runtime=runtime_min("adjust_bundle"),
    params:
        job=job_params("adjust_bundle"),
        files=job_files(),
    shell:
        job_command("adjust_bundle")
