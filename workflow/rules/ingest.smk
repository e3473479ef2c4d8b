# From image files to an index.


rule index_images:
    output:
        artifact("index_images", "index.h5"),
    log:
        log_file("index_images"),
    threads: 2
    resources:
        mem_mb=memory_mb("index_images"),
        runtime=runtime_min("index_images"),
    params:
        job=job_params("index_images"),
        files=job_files(),
    shell:
        job_command("index_images")
