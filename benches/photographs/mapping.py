"""Structure from motion by pycolmap on the processor: one SIMPLE_RADIAL camera for all."""

import numpy as np

THREADS = 2
NEIGHBOURS = 20
# Features of each photograph, the largest, that are compared to find likely partners.
COMPARED = 800
LEAST_MATCHES = 6


def structure_from_motion(work, photographs, recipe):
    """Returns the largest model."""
    import pycolmap

    pycolmap.logging.minloglevel = 2
    database, images = work / "database.db", work / "images"
    database.unlink(missing_ok=True)
    extract(database, images, photographs, recipe)
    match(database, photographs, recipe)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.multiple_models, options.max_num_models = THREADS, 1, True, 5
    (work / "models").mkdir(exist_ok=True)
    models = pycolmap.incremental_mapping(database, images, work / "models", options=options)
    return max(models.values(), key=lambda model: model.num_reg_images())


def extract(database, images, photographs, recipe):
    import pycolmap

    sizes = {photograph.size for photograph in photographs}
    if len(sizes) != 1:
        raise SystemExit("photographs of several sizes: %s" % sorted(sizes))
    ((width, height),) = sizes
    reader, options = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
    reader.camera_model = "SIMPLE_RADIAL"
    reader.camera_params = "%r,%r,%r,0" % (float(recipe.focal), width / 2, height / 2)
    options.num_threads, options.use_gpu, options.sift.max_num_features = THREADS, False, recipe.features
    pycolmap.extract_features(
        database, images, image_names=[p.name for p in photographs], camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader, extraction_options=options, device=pycolmap.Device.cpu,
    )  # fmt: skip


def match(database, photographs, recipe):
    import pycolmap

    options, cpu = pycolmap.FeatureMatchingOptions(), pycolmap.Device.cpu
    options.num_threads, options.use_gpu = THREADS, False
    if recipe.partners == "near":
        write_priors(database, {p.name: p.gps for p in photographs})
        pairing = pycolmap.SpatialPairingOptions()
        pairing.ignore_z, pairing.max_num_neighbors, pairing.max_distance, pairing.num_threads = True, NEIGHBOURS, 500, THREADS
        pycolmap.match_spatial(database, matching_options=options, pairing_options=pairing, device=cpu)
    elif recipe.partners == "all":
        pycolmap.match_exhaustive(database, matching_options=options, device=cpu)
    else:
        listed, pairing = database.with_name("pairs.txt"), pycolmap.ImportedPairingOptions()
        listed.write_text("".join("%s %s\n" % pair for pair in likely_pairs(database, recipe.partners)))
        pairing.match_list_path = listed
        pycolmap.match_image_pairs(database, options, pairing)


def write_priors(database, places):
    import pycolmap

    opened = pycolmap.Database.open(database)
    for image in opened.read_all_images():
        if places[image.name] is None:
            continue
        system = pycolmap.PosePriorCoordinateSystem.WGS84
        prior = pycolmap.PosePrior(position=np.array(places[image.name]), coordinate_system=system)
        prior.corr_data_id = image.data_id
        opened.write_pose_prior(prior)
    opened.close()


def largest_features(database):
    """Names, and unit descriptors of the largest features of each."""
    import pycolmap

    opened, names, descriptors = pycolmap.Database.open(database), [], []
    for image in opened.read_all_images():
        keypoints, read = np.asarray(opened.read_keypoints(image.image_id)), opened.read_descriptors(image.image_id)
        values = np.asarray(getattr(read, "data", read)).astype(np.float32)
        size = np.hypot(keypoints[:, 2], keypoints[:, 4]) if keypoints.shape[1] == 6 else keypoints[:, 2]
        best = values[np.argsort(-size)[:COMPARED]]
        descriptors.append(best / (np.linalg.norm(best, axis=1, keepdims=True) + 1e-9))
        names.append(image.name)
    opened.close()
    return names, descriptors


def mutual_matches(a, b):
    """Matches that are the best both ways and clearly better than the second."""
    similar = a @ b.T
    best, rows = similar.argmax(1), np.arange(len(similar))
    first, back = similar[rows, best], similar.argmax(0)[best] == rows
    similar[rows, best] = -1
    clear = np.arccos(np.clip(first, -1, 1)) < 0.8 * np.arccos(np.clip(similar.max(1), -1, 1))
    return np.sum(back & clear)


def likely_pairs(database, partners):
    """For each photograph the likeliest partners by a quick comparison."""
    names, descriptors = largest_features(database)
    count = len(names)
    score = np.zeros((count, count))
    for i in range(count):
        for j in range(i):
            score[i, j] = score[j, i] = mutual_matches(descriptors[i], descriptors[j])
    best = np.argsort(-score, axis=1, kind="stable")[:, :partners]
    pairs = {(min(i, j), max(i, j)) for i in range(count) for j in best[i] if i != j and score[i, j] >= LEAST_MATCHES}
    return [(names[i], names[j]) for i, j in sorted(pairs)]
