# Local and global descriptors, and the pairs of images worth matching.


rule extract_features:
    input:
        index=artifact("index_images", "index.h5"),
    output:
        artifact("extract_features", "{block}.h5"),
    log:
        log_file("extract_features", "{block}"),
    resources:
        gpu=gpus("extract_features"),
        mem_mb=memory_mb("extract_features"),
        runtime=runtime_min("extract_features"),
    params:
        job=job_params("extract_features"),
        files=job_files(),
    shell:
        job_command("extract_features")


rule learn_vocabulary:
    input:
        features=files_of("extract_features", "blocks"),
    output:
        artifact("learn_vocabulary", "vocabulary.h5"),
    log:
        log_file("learn_vocabulary"),
    resources:
        mem_mb=memory_mb("learn_vocabulary"),
        runtime=runtime_min("learn_vocabulary"),
    params:
        job=job_params("learn_vocabulary"),
        files=job_files(),
    shell:
        job_command("learn_vocabulary")


rule describe_images:
    input:
        features=of_scene(rule_inputs.described_features, "block"),
        vocabulary=of_scene(ScenePlan.vocabulary),
        index=of_scene(rule_inputs.described_images),
    output:
        artifact("describe_images", "{block}.h5"),
    log:
        log_file("describe_images", "{block}"),
    resources:
        gpu=gpus("describe_images"),
        mem_mb=memory_mb("describe_images"),
        runtime=runtime_min("describe_images"),
    params:
        job=job_params("describe_images"),
        files=job_files(),
    shell:
        job_command("describe_images")


share_resources(workflow.resource_settings, "select_pairs", PLAN.select_pairs_twins())


# the outputs of a rule cannot depend on the scene, so scenes with another number of blocks have their own rule
for blocks, scenes in PLAN.scenes_by_blocks().items():

    rule:
        name:
            PLAN.select_pairs_rule(blocks)
        input:
            index=artifact("index_images", "index.h5"),
            descriptors=of_scene(rule_inputs.global_descriptors),
            features=of_scene(rule_inputs.previewed_features),
        output:
            [artifact("select_pairs", f"{tile}.h5") for tile in tile_names(blocks)],
        log:
            log_file("select_pairs"),
        wildcard_constraints:
            scene=any_of(scenes),
        # blocks of the similarity matrix are computed in parallel, and so are previews of pairs
        threads: 2
        resources:
            mem_mb=memory_mb("select_pairs"),
            runtime=runtime_min("select_pairs"),
        params:
            job=job_params("select_pairs"),
            files=job_files(),
        shell:
            job_command("select_pairs")
