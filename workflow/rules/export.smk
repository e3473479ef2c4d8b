# The model in the formats that others read, and how good it is.


rule export_model:
    input:
        index=artifact("index_images", "index.h5"),
        reconstruction=artifact("adjust_bundle", "reconstruction.h5"),
    output:
        artifact("export_model", "sparse/0/cameras.bin"),
        artifact("export_model", "sparse/0/images.bin"),
        artifact("export_model", "sparse/0/points3D.bin"),
        artifact("export_model", "sparse/0/cameras.txt"),
        artifact("export_model", "sparse/0/images.txt"),
        artifact("export_model", "sparse/0/points3D.txt"),
        artifact("export_model", "points.ply"),
        artifact("export_model", "transforms.json"),
        artifact("export_model", "summary.json"),
    log:
        log_file("export_model"),
    benchmark:
        benchmark_file("export_model")
    params:
        job=job_params("export_model"),
    script:
        "../../scripts/export_model.py"


rule evaluate_model:
    input:
        index=artifact("index_images", "index.h5"),
        reconstruction=artifact("adjust_bundle", "reconstruction.h5"),
    output:
        artifact("evaluate_model", "metrics.json"),
        artifact("evaluate_model", "metrics.csv"),
    log:
        log_file("evaluate_model"),
    benchmark:
        benchmark_file("evaluate_model")
    params:
        job=job_params("evaluate_model"),
    script:
        "../../scripts/evaluate_model.py"
