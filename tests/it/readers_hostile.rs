//! Damaged, contradictory and hostile models: an error with place and cure, no panic, no memory for
//! what is only announced.

use viewrank_core::{
    base::error::{Advice, Hint},
    model::scene::Scene,
};
use viewrank_io::{
    formats::{Bytes, Fault, Place, Problem, colmap_bin, colmap_text},
    project::{Project, ProjectError},
};

/// A small model, binary: two images, two points.
struct Files {
    cameras: Vec<u8>,
    images: Vec<u8>,
    points3d: Vec<u8>,
    rigs: Option<Vec<u8>>,
    frames: Option<Vec<u8>>,
}

fn u32s(values: &[u32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

fn u64s(values: &[u64]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

fn f64s(values: &[f64]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

const NO_POINT: u64 = u64::MAX;

fn camera(id: u32, model: u32, size: [u64; 2], params: &[f64]) -> Vec<u8> {
    [u32s(&[id, model]), u64s(&size), f64s(params)].concat()
}

fn image(id: u32, pose: [f64; 7], camera: u32, name: &[u8], points: &[([f64; 2], u64)]) -> Vec<u8> {
    let list = points
        .iter()
        .flat_map(|(xy, id)| [f64s(xy), u64s(&[*id])].concat());
    let head = [
        u32s(&[id]),
        f64s(&pose),
        u32s(&[camera]),
        name.to_vec(),
        vec![0],
        u64s(&[points.len() as u64]),
    ];
    head.concat().into_iter().chain(list).collect()
}

fn point(id: u64, xyz: [f64; 3], track: &[[u32; 2]]) -> Vec<u8> {
    let elements = track.iter().flat_map(|e| u32s(e));
    let head = [
        u64s(&[id]),
        f64s(&xyz),
        vec![10, 20, 30],
        f64s(&[0.5]),
        u64s(&[track.len() as u64]),
    ];
    head.concat().into_iter().chain(elements).collect()
}

fn counted(records: &[Vec<u8>]) -> Vec<u8> {
    [u64s(&[records.len() as u64]), records.concat()].concat()
}

const POSE: [f64; 7] = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
const LIST: [([f64; 2], u64); 3] = [([1.0, 2.0], 7), ([3.0, 4.0], NO_POINT), ([5.0, 6.0], 9)];

fn valid() -> Files {
    Files {
        cameras: counted(&[camera(1, 0, [100, 80], &[90.0, 50.0, 40.0])]),
        images: counted(&[
            image(1, POSE, 1, b"a.jpg", &LIST),
            image(2, POSE, 1, b"b.jpg", &LIST),
        ]),
        points3d: counted(&[
            point(7, [0.0, 0.0, 5.0], &[[1, 0], [2, 0]]),
            point(9, [1.0, 0.0, 5.0], &[[2, 2], [1, 2]]),
        ]),
        rigs: None,
        frames: None,
    }
}

fn read(files: &Files) -> Result<Scene, Fault> {
    let bytes = Bytes {
        cameras: &files.cameras,
        images: &files.images,
        points3d: &files.points3d,
        rigs: files.rigs.as_deref(),
        frames: files.frames.as_deref(),
    };
    colmap_bin::read(&bytes)?.scene()
}

fn fault(change: impl FnOnce(&mut Files)) -> Fault {
    let mut files = valid();
    change(&mut files);
    let fault = read(&files).unwrap_err();
    assert_ne!(fault.problem.hint(), Advice::default());
    fault
}

fn text(cameras: &str, images: &str, points3d: &str) -> Result<Scene, Fault> {
    let (cameras, images, points3d) = (cameras.as_bytes(), images.as_bytes(), points3d.as_bytes());
    colmap_text::read(&Bytes {
        cameras,
        images,
        points3d,
        rigs: None,
        frames: None,
    })?
    .scene()
}

const CAMERAS_TXT: &str = "# comment\n1 SIMPLE_PINHOLE 100 80 90 50 40\n";
const IMAGES_TXT: &str =
    "1 1 0 0 0 0 0 0 1 a.jpg\n1 2 7 3 4 -1\n2 1 0 0 0 0 0 0 1 b b.jpg\n1 2 7\n";
const POINTS_TXT: &str = "7 0 0 5 10 20 30 0.5 1 0 2 0\n";

#[test]
fn the_valid_models_are_read() {
    let scene = read(&valid()).unwrap();
    assert_eq!(
        (scene.views.len(), scene.points.len(), scene.observations()),
        (2, 2, 4)
    );
    assert_eq!(
        scene.track_pixels,
        [[1.0, 2.0], [1.0, 2.0], [5.0, 6.0], [5.0, 6.0]]
    );
    let scene = text(CAMERAS_TXT, IMAGES_TXT, POINTS_TXT).unwrap();
    assert_eq!(
        (scene.views.len(), scene.points.len(), scene.observations()),
        (2, 1, 2)
    );
    assert_eq!(scene.views[1].name, "b b.jpg");
}

#[test]
fn every_truncation_is_an_error() {
    let whole = valid();
    for (n, file) in [&whole.cameras, &whole.images, &whole.points3d]
        .into_iter()
        .enumerate()
    {
        for length in 0..file.len() {
            let fault = fault(|files| {
                [&mut files.cameras, &mut files.images, &mut files.points3d][n].truncate(length);
            });
            assert!(
                matches!(fault.problem, Problem::Truncated(_) | Problem::Count { .. }),
                "{length}: {fault}"
            );
            assert!(
                matches!(fault.place, Place::Byte(at) if at as usize <= length),
                "{length}: {fault}"
            );
        }
    }
}

#[test]
fn a_count_of_2_to_the_60_allocates_nothing() {
    let count = |file: fn(&mut Files) -> &mut Vec<u8>, at: usize, expected: &str| {
        let fault =
            fault(|files| file(files)[at..at + 8].copy_from_slice(&(1u64 << 60).to_le_bytes()));
        assert!(
            matches!(fault.problem, Problem::Count { count, .. } if count == 1 << 60),
            "{fault}"
        );
        assert_eq!(fault.place, Place::Byte(at as u64), "{expected}");
    };
    count(|f| &mut f.cameras, 0, "cameras");
    count(|f| &mut f.images, 0, "images");
    count(|f| &mut f.images, 8 + 4 + 56 + 4 + 6, "2D points");
    count(|f| &mut f.points3d, 0, "points");
    count(|f| &mut f.points3d, 8 + 8 + 24 + 3 + 8, "track");
}

#[test]
fn bytes_after_the_end_are_a_warning() {
    let mut files = valid();
    files.points3d.extend([1, 2, 3]);
    let scene = read(&files).unwrap();
    assert_eq!(
        scene.warnings[0].text,
        "points3D.bin: 3 bytes after the last of 2 records are ignored"
    );
    assert_eq!(scene.warnings.len(), 1);
}

#[test]
fn cameras_are_checked() {
    let with = |records: &[Vec<u8>]| fault(|files| files.cameras = counted(records)).problem;
    let good = camera(1, 0, [100, 80], &[90.0, 50.0, 40.0]);
    assert_eq!(
        with(&[camera(1, 18, [100, 80], &[])]),
        Problem::CameraModel("18".into())
    );
    assert!(matches!(
        with(&[camera(1, 0, [100, 80], &[f64::NAN, 50.0, 40.0])]),
        Problem::Camera(_)
    ));
    assert!(matches!(
        with(&[camera(1, 0, [100, 80], &[-90.0, 50.0, 40.0])]),
        Problem::Camera(_)
    ));
    assert!(matches!(
        with(&[camera(1, 0, [100, 1 << 40], &[90.0, 50.0, 40.0])]),
        Problem::Camera(_)
    ));
    assert!(matches!(
        with(&[good.clone(), good]),
        Problem::Duplicate { what: "camera", .. }
    ));
    assert_eq!(
        with(&[]),
        Problem::Absent {
            what: "camera",
            id: 1
        }
    );
}

#[test]
fn poses_are_checked() {
    let with = |pose| fault(|files| files.images = counted(&[image(1, pose, 1, b"a.jpg", &LIST)]));
    let zero = with([0.0; 7]);
    assert_eq!(zero.problem, Problem::ZeroQuaternion);
    assert_eq!(zero.place, Place::Byte(8));
    assert_eq!(zero.record.as_deref(), Some("image 1, \"a.jpg\""));
    for n in 0..7 {
        for value in [f64::NAN, f64::INFINITY] {
            let mut pose = POSE;
            pose[n] = value;
            assert_eq!(with(pose).problem, Problem::NotFinite("the pose"));
        }
    }
    // Lengths far from one are no harm.
    for scale in [1e-300, 1e300, -2.0] {
        let mut files = valid();
        let pose = [0.6 * scale, 0.0, 0.8 * scale, 0.0, 1.0, 2.0, 3.0];
        files.images = counted(&[
            image(1, pose, 1, b"a.jpg", &LIST),
            image(2, POSE, 1, b"b.jpg", &LIST),
        ]);
        let rotation = read(&files).unwrap().views[0].cam_from_world.rotation;
        assert!(
            (rotation.matrix()[(0, 0)] - (0.36 - 0.64)).abs() < 1e-12,
            "{scale}"
        );
    }
}

#[test]
fn names_are_checked() {
    let with = |name: &[u8]| {
        fault(|files| files.images = counted(&[image(1, POSE, 1, name, &LIST)])).problem
    };
    for name in ["", "../../etc/passwd", "/etc/passwd", "a/../../../b.jpg"] {
        assert!(
            matches!(with(name.as_bytes()), Problem::Name { .. }),
            "{name}"
        );
    }
    assert!(matches!(
        with(b"stra\xdfe.jpg"),
        Problem::Name {
            why: "is not UTF-8",
            ..
        }
    ));
    let twice = fault(|files| {
        files.images = counted(&[
            image(1, POSE, 1, b"a.jpg", &LIST),
            image(2, POSE, 1, b"a.jpg", &LIST),
        ]);
    });
    assert_eq!(
        twice.problem,
        Problem::Duplicate {
            what: "image name",
            id: "a.jpg".into()
        }
    );
}

#[test]
fn ids_are_unique() {
    let images = fault(|files| {
        files.images = counted(&[
            image(1, POSE, 1, b"a.jpg", &LIST),
            image(1, POSE, 1, b"b.jpg", &LIST),
        ]);
    });
    assert_eq!(
        images.problem,
        Problem::Duplicate {
            what: "image",
            id: "1".into()
        }
    );
    let points = fault(|files| {
        let track: &[[u32; 2]] = &[[1, 0], [2, 0]];
        let other = point(9, [0.0; 3], &[]);
        files.points3d = counted(&[point(7, [0.0; 3], track), other, point(7, [0.0; 3], track)]);
    });
    assert_eq!(
        points.problem,
        Problem::Duplicate {
            what: "point",
            id: "7".into()
        }
    );
    assert_eq!(points.place, Place::Byte(8 + 51 + 16 + 51));
}

#[test]
fn tracks_lead_to_2d_points_of_their_images() {
    let with = |track: &[[u32; 2]]| {
        fault(|files| files.points3d = counted(&[point(8, [0.0, 0.0, 5.0], track)])).problem
    };
    assert_eq!(
        with(&[[1, 1], [33, 0]]),
        Problem::Absent {
            what: "image",
            id: 33
        }
    );
    assert!(matches!(
        with(&[[1, 1], [2, u32::MAX]]),
        Problem::TrackIndex {
            image: 2,
            index: u32::MAX,
            ..
        }
    ));
    // The 2D point observes point 9.
    assert!(matches!(
        with(&[[1, 1], [2, 2]]),
        Problem::TrackIndex {
            image: 2,
            index: 2,
            ..
        }
    ));
    let nan =
        fault(|files| files.points3d = counted(&[point(8, [0.0, f64::NAN, 5.0], &[])])).problem;
    assert_eq!(nan, Problem::NotFinite("the position"));
    let nan = fault(|files| {
        let list = [([f64::NAN, 1.0], 7), LIST[1], LIST[2]];
        files.images = counted(&[
            image(1, POSE, 1, b"a.jpg", &list),
            image(2, POSE, 1, b"b.jpg", &LIST),
        ]);
    });
    assert_eq!(
        (nan.file, nan.problem),
        ("images", Problem::NotFinite("a 2D point"))
    );
    // As COLMAP: a track may claim a 2D point that is linked to no point.
    let mut files = valid();
    files.points3d = counted(&[point(8, [0.0, 0.0, 5.0], &[[1, 1], [2, 1]])]);
    assert_eq!(read(&files).unwrap().track_pixels, [[3.0, 4.0]; 2]);
}

/// Numbers of features, far beyond the lists of 2D points, or at a wrong place in them.
fn assert_lists_decide_over_tracks() {
    let mut files = valid();
    files.points3d = counted(&[
        point(7, [0.0, 0.0, 5.0], &[[1, 4711], [2, 815]]),
        point(9, [1.0, 0.0, 5.0], &[[2, 0], [1, 2]]),
    ]);
    let scene = read(&files).unwrap();
    assert_eq!(scene.track_pixels, read(&valid()).unwrap().track_pixels);
    assert_eq!(scene.warnings.len(), 1);
    assert!(
        scene.warnings[0].text.starts_with("3 of 4 track elements"),
        "{:?}",
        scene.warnings
    );
}

#[test]
fn openmvg_colmap_featid() {
    assert_lists_decide_over_tracks();
}

#[test]
fn alicevision_colmap_featid() {
    assert_lists_decide_over_tracks();
}

#[test]
fn openmvg_colmap_image_id_zero() {
    let mut files = valid();
    files.images = counted(&[
        image(0, POSE, 1, b"a.jpg", &LIST),
        image(2, POSE, 1, b"b.jpg", &LIST),
    ]);
    files.points3d = counted(&[point(7, [0.0, 0.0, 5.0], &[[0, 0], [2, 0]])]);
    assert_eq!(read(&files).unwrap().observations(), 2);
}

fn rig(id: u32, sensors: &[(u32, Option<[f64; 7]>)]) -> Vec<u8> {
    let mut bytes = u32s(&[id, sensors.len() as u32]);
    for (n, (camera, pose)) in sensors.iter().enumerate() {
        bytes.extend(u32s(&[0, *camera]));
        if n > 0 {
            bytes.push(pose.is_some().into());
            bytes.extend(f64s(pose.as_ref().map_or(&[], |p| p)));
        }
    }
    bytes
}

fn frame(id: u32, rig: u32, pose: [f64; 7], data: &[[u32; 2]]) -> Vec<u8> {
    let data_ids = data
        .iter()
        .flat_map(|[camera, image]| [u32s(&[0, *camera]), u64s(&[(*image).into()])].concat());
    let head = [u32s(&[id, rig]), f64s(&pose), u32s(&[data.len() as u32])].concat();
    head.into_iter().chain(data_ids).collect()
}

fn with_frames(rigs: &[Vec<u8>], frames: &[Vec<u8>]) -> Result<Scene, Fault> {
    read(&Files {
        rigs: Some(counted(rigs)),
        frames: Some(counted(frames)),
        ..valid()
    })
}

#[test]
fn rigs_and_frames_agree_with_the_images() {
    let rigs = [rig(1, &[(1, None)])];
    let frames = [frame(1, 1, POSE, &[[1, 1]]), frame(2, 1, POSE, &[[1, 2]])];
    assert_eq!(with_frames(&rigs, &frames).unwrap().warnings, []);
    let problem =
        |rigs: &[Vec<u8>], frames: &[Vec<u8>]| with_frames(rigs, frames).unwrap_err().problem;
    let far = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0];
    assert!(matches!(
        problem(&rigs, &[frame(1, 1, far, &[[1, 1]])]),
        Problem::Contradiction(_)
    ));
    assert!(matches!(
        problem(&rigs, &frames[..1]),
        Problem::Contradiction(_)
    ));
    assert_eq!(
        problem(&[], &frames),
        Problem::Absent { what: "rig", id: 1 }
    );
    assert_eq!(
        problem(&[rig(1, &[(5, None)])], &frames),
        Problem::Absent {
            what: "camera",
            id: 5
        }
    );
    assert_eq!(
        problem(&rigs, &[frame(1, 1, POSE, &[[1, 66]])]),
        Problem::Absent {
            what: "image",
            id: 66
        }
    );
    assert_eq!(
        problem(&rigs, &[frame(1, 1, POSE, &[[2, 1]])]),
        Problem::Absent {
            what: "camera of the rig",
            id: 2
        }
    );
    assert!(matches!(
        problem(&[rigs.concat(), rigs.concat()], &frames),
        Problem::Duplicate { what: "rig", .. }
    ));
    let twice = [frame(1, 1, POSE, &[[1, 1], [1, 1]])];
    assert!(matches!(
        problem(&rigs, &twice),
        Problem::Duplicate { what: "image", .. }
    ));
    assert_eq!(
        problem(&rigs, &[frame(1, 1, [0.0; 7], &[[1, 1]])]),
        Problem::ZeroQuaternion
    );
    // One of the two files alone says nothing.
    let alone = read(&Files {
        rigs: Some(counted(&rigs)),
        ..valid()
    })
    .unwrap();
    assert_eq!(alone.warnings.len(), 1);
    for length in 0..counted(&frames).len() {
        let cut = counted(&frames)[..length].to_vec();
        assert!(
            read(&Files {
                rigs: Some(counted(&rigs)),
                frames: Some(cut),
                ..valid()
            })
            .is_err()
        );
    }
    let many = [u32s(&[1, u32::MAX]), vec![0; 40]].concat();
    assert!(matches!(
        problem(&[many], &frames),
        Problem::Count {
            what: "sensors",
            ..
        }
    ));
}

#[test]
fn text_faults_have_lines() {
    let fault =
        |cameras: &str, images: &str, points: &str| text(cameras, images, points).unwrap_err();
    let camera = fault(
        "# x\n\n1 PINHOLE 100 80 1 2 3 4 five\n",
        IMAGES_TXT,
        POINTS_TXT,
    );
    assert_eq!((camera.file, camera.place), ("cameras", Place::Line(3)));
    assert_eq!(
        camera.problem,
        Problem::Syntax {
            expected: "a camera parameter",
            found: "five".into()
        }
    );
    assert_eq!(
        fault("1 NICE 1 1 1", IMAGES_TXT, POINTS_TXT).problem,
        Problem::CameraModel("NICE".into())
    );
    let image = fault(CAMERAS_TXT, "1 1 0 0 0 0 0 0 1 a.jpg\n1 2\n", POINTS_TXT);
    assert_eq!((image.file, image.place), ("images", Place::Line(2)));
    assert_eq!(image.record.as_deref(), Some("image 1, \"a.jpg\""));
    let id = fault(CAMERAS_TXT, "1 1 0 0 0 0 0 0 1 a.jpg\n1 2 -5\n", POINTS_TXT);
    assert!(
        matches!(id.problem, Problem::Syntax { ref found, .. } if found == "-5"),
        "{id}"
    );
    assert!(matches!(
        fault(CAMERAS_TXT, "1 nan 0 0 0 0 0 0 1 a.jpg\n\n", "").problem,
        Problem::NotFinite(_)
    ));
    assert!(matches!(
        fault(CAMERAS_TXT, "1 1 0 0 0 0 0 0 1\n\n", "").problem,
        Problem::Name { .. }
    ));
    assert!(matches!(
        fault(CAMERAS_TXT, "1 1 0 0 0 0 0 0 1 ../../x\n\n", "").problem,
        Problem::Name { .. }
    ));
    let point = fault(CAMERAS_TXT, IMAGES_TXT, "7 0 0 5 10 20 300 0.5 1 0\n");
    assert!(
        matches!(
            point.problem,
            Problem::Syntax {
                expected: "a colour from 0 to 255",
                ..
            }
        ),
        "{point}"
    );
    let point = fault(CAMERAS_TXT, IMAGES_TXT, "\n7 0 0 5 10 20 30 0.5 1 0 2\n");
    assert_eq!(point.place, Place::Line(2));
    assert!(matches!(
        fault(CAMERAS_TXT, IMAGES_TXT, "7 0 0 5 1 2 3 0.5 8 0\n").problem,
        Problem::Absent { .. }
    ));
}

#[test]
fn a_missing_last_line_is_an_image_without_points() {
    let scene = text(CAMERAS_TXT, "1 1 0 0 0 0 0 0 1 a.jpg", "").unwrap();
    assert_eq!((scene.views.len(), scene.warnings.len()), (1, 1));
    // Blank lines between records are none, the empty line of an image without points is.
    let scene = text(
        CAMERAS_TXT,
        "\n\n1 1 0 0 0 0 0 0 1 a.jpg\r\n\r\n# c\r\n2 1 0 0 0 0 0 0 1 b.jpg\r\n\r\n",
        "",
    )
    .unwrap();
    assert_eq!((scene.views.len(), scene.warnings.len()), (2, 0));
}

#[test]
fn errors_of_a_project_name_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let mut files = valid();
    files.images.truncate(200);
    for (name, bytes) in [
        ("cameras", &files.cameras),
        ("images", &files.images),
        ("points3D", &files.points3d),
    ] {
        std::fs::write(folder.path().join(name).with_extension("bin"), bytes).unwrap();
    }
    let error = Project::open(folder.path(), None)
        .unwrap()
        .read_scene()
        .unwrap_err();
    let message = error.to_string();
    assert!(message.contains("images.bin, byte"), "{message}");
    assert!(message.contains("image 2 of 2"), "{message}");
    assert!(error.hint().is_some());
    // A count that is not true neither wins nor harms when sub-models are compared.
    std::fs::write(folder.path().join("images.bin"), u64s(&[1 << 60])).unwrap();
    let project = Project::open(folder.path(), None).unwrap();
    assert_eq!(project.model.registered, 0);
    assert!(matches!(
        project.read_scene().unwrap_err(),
        ProjectError::Fault { .. }
    ));
    // Empty files, too.
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        std::fs::write(folder.path().join(name), b"").unwrap();
    }
    let error = Project::open(folder.path(), None)
        .unwrap()
        .read_scene()
        .unwrap_err();
    assert!(
        error
            .to_string()
            .contains("cameras.bin, byte 0: the file ends within a count"),
        "{error}"
    );
}
