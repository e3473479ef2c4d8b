# The report.


rule render_report:
    input:
        index=artifact("index_images", "index.h5"),
        cameras=artifact("calibrate_cameras", "cameras.h5"),
        geometries=files_of("estimate_two_view", "tiles"),
        graph=artifact("filter_view_graph", "graph.h5"),
        rotations=artifact("average_rotations", "rotations.h5"),
        tracks=artifact("build_tracks", "tracks.h5"),
        centers=artifact("average_translations", "centers.h5"),
        points=artifact("triangulate_tracks", "points.h5"),
        reconstruction=artifact("adjust_bundle", "reconstruction.h5"),
        metrics=artifact("evaluate_model", "metrics.json"),
        summary=artifact("export_model", "summary.json"),
    output:
        report(
            artifact("render_report", "index.html"),
            category="{scene}",
            labels={"file": "what each stage kept and refused"},
        ),
    log:
        log_file("render_report"),
    resources:
        mem_mb=memory_mb("render_report"),
        runtime=runtime_min("render_report"),
    params:
        job=job_params("render_report"),
        files=job_files(),
    shell:
        job_command("render_report")
