# The model and its inputs in the formats of other tools, and its evaluation.


rule export_database:
    input:
        index=artifact("index_images", "index.h5"),
        cameras=artifact("calibrate_cameras", "cameras.h5"),
        features=of_scene(rule_inputs.keypoint_files),
        matches=of_scene(rule_inputs.match_files),
        geometries=files_of("estimate_two_view", "tiles"),
    output:
        artifact("export_database", "database.db"),
    log:
        log_file("export_database"),
    resources:
        mem_mb=memory_mb("export_database"),
        runtime=runtime_min("export_database"),
    params:
        job=job_params("export_database"),
        files=job_files(),
    shell:
        job_command("export_database")


localrules:
    hloc,


rule hloc:
    input:
        all_hloc_files(),


rule export_hloc:
    input:
        index=artifact("index_images", "index.h5"),
        features=of_scene(rule_inputs.keypoint_files),
        matches=of_scene(rule_inputs.match_files),
        geometries=files_of("estimate_two_view", "tiles"),
    output:
        artifact("export_hloc", "features.h5"),
        artifact("export_hloc", "matches.h5"),
        artifact("export_hloc", "pairs.txt"),
    log:
        log_file("export_hloc"),
    resources:
        mem_mb=memory_mb("export_hloc"),
        runtime=runtime_min("export_hloc"),
    params:
        job=job_params("export_hloc"),
        files=job_files(),
    shell:
        job_command("export_hloc")


rule export_model:
    input:
        index=artifact("index_images", "index.h5"),
        cameras=artifact("calibrate_cameras", "cameras.h5"),
        features=of_scene(rule_inputs.exported_keypoints),
        reconstruction=artifact("adjust_bundle", "reconstruction.h5"),
    output:
        [artifact("export_model", name) for name in MODEL_FILES],
    log:
        log_file("export_model"),
    threads: undistorting_threads
    resources:
        mem_mb=memory_mb("export_model"),
        runtime=runtime_min("export_model"),
    params:
        job=job_params("export_model"),
        files=job_files(),
    shell:
        job_command("export_model")


rule evaluate_model:
    input:
        index=artifact("index_images", "index.h5"),
        reconstruction=artifact("adjust_bundle", "reconstruction.h5"),
    output:
        artifact("evaluate_model", "metrics.json"),
        report(
            artifact("evaluate_model", "metrics.csv"),
            category="{scene}",
            labels={"file": "metrics"},
        ),
    log:
        log_file("evaluate_model"),
    resources:
        mem_mb=memory_mb("evaluate_model"),
        runtime=runtime_min("evaluate_model"),
    params:
        job=job_params("evaluate_model"),
        files=job_files(),
    shell:
        job_command("evaluate_model")
