//! A broken project for each kind of finding, and a healthy one; `traps` has one for each trap of a
//! backend.

use std::fs;

use nalgebra::{Matrix3, Point3, Rotation3, Vector3};
use tempfile::TempDir;

use super::{Finding, NO_TRACKS, Severity, ViewFinding, examine};
use crate::{
    backends::{self, Backend},
    config::{ConfidenceSource, FrameSettings, Settings, TargetSettings},
    io::{
        formats::{colmap::ColmapModel, colmap_bin},
        project::{ModelFormat, ModelLocation, Project, ProjectKind},
    },
    model::{
        camera::{Camera, CameraModel},
        scene::{CameraIndex, ModelWarning, Pose, Scene, Units, View, ViewIndex, WarningKind},
    },
};

mod traps;

/// A view at `centre` that looks at `target`, +y of the world up in the image.
fn view(name: &str, centre: [f64; 3], target: [f64; 3]) -> View {
    let forward = (Vector3::from(target) - Vector3::from(centre)).normalize();
    let right = forward.cross(&Vector3::y()).normalize();
    let rows = [
        right.transpose(),
        forward.cross(&right).transpose(),
        forward.transpose(),
    ];
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_rows(&rows));
    let cam_from_world = Pose {
        rotation,
        translation: -(rotation * Vector3::from(centre)),
    };
    View {
        name: name.into(),
        image_id: 0,
        file_position: 0,
        camera: CameraIndex(0),
        cam_from_world,
    }
}

fn down(name: &str, x: f64, y: f64, z: f64) -> View {
    view(name, [x, y, z], [x, y, 0.0])
}

/// A point on gentle hills.
fn ground(x: f64, y: f64) -> Point3<f64> {
    Point3::new(x, y, (0.3 * x).sin() + (0.2 * y).cos())
}

fn square(middle: f64, half: i32) -> impl Iterator<Item = Point3<f64>> {
    (-half..=half)
        .flat_map(move |i| (-half..=half).map(move |j| ground(middle + f64::from(i), f64::from(j))))
}

/// A scene in which every view observes every point within its image, except where `lost` (view
/// name, point) is true.
fn scene_of(
    mut views: Vec<View>,
    points: impl Iterator<Item = Point3<f64>>,
    lost: impl Fn(&str, &Point3<f64>) -> bool,
) -> Scene {
    views.sort_by(|a, b| a.name.cmp(&b.name));
    let camera = Camera::new(
        1,
        CameraModel::Pinhole,
        1000,
        750,
        vec![850.0, 850.0, 500.0, 375.0],
    )
    .unwrap();
    let mut scene = Scene {
        cameras: vec![camera],
        views,
        track_offsets: vec![0],
        ..Default::default()
    };
    for (i, view) in scene.views.iter_mut().enumerate() {
        (view.image_id, view.file_position) = (i as u32 + 1, i as u32);
    }
    for point in points {
        add_point(&mut scene, point, |name| !lost(name, &point));
    }
    scene
}

fn add_point(scene: &mut Scene, point: Point3<f64>, observes: impl Fn(&str) -> bool) {
    for v in (0..scene.views.len() as u32).map(ViewIndex) {
        let pixel = scene
            .camera_of(v)
            .project(&scene.view(v).cam_from_world.camera_from_world(&point));
        if let Some(pixel) =
            pixel.filter(|p| scene.camera_of(v).contains(p) && observes(scene.name(v)))
        {
            scene.track_views.push(v);
            scene.track_pixels.push([pixel.x, pixel.y]);
        }
    }
    scene.points.push(point);
    scene.point_ids.push(scene.points.len() as u64);
    scene.colours.push([128; 3]);
    scene.track_offsets.push(scene.track_views.len());
}

/// Five by five views, 8 m apart, 40 m up.
fn block(middle: f64, prefix: &str) -> Vec<View> {
    let at = |i: i32| 8.0 * f64::from(i - 2);
    (0..25)
        .map(|i| {
            down(
                &format!("{prefix}{i:02}.jpg"),
                middle + at(i % 5),
                at(i / 5),
                40.0,
            )
        })
        .collect()
}

fn healthy() -> Scene {
    scene_of(block(0.0, "n"), square(0.0, 34), |_, _| false)
}

/// A project in a folder of its own, without images.
fn project(format: ModelFormat) -> (TempDir, Project) {
    let folder = tempfile::tempdir().unwrap();
    let model = ModelLocation::new(format, folder.path().join("sparse/0"));
    fs::create_dir_all(&model.path).unwrap();
    let project = Project {
        home: folder.path().into(),
        named: folder.path().into(),
        root: folder.path().into(),
        kind: ProjectKind::Colmap,
        model,
        model_is_named: false,
        other_models: Vec::new(),
        images: None,
        originals: None,
        dense_workspace: None,
        model_stamps: Vec::new(),
    };
    (folder, project)
}

/// The findings for a scene without images and one backend, apart from `no-images`.
fn diagnose(scene: &Scene, backend: &str, settings: &Settings) -> Vec<Finding> {
    let (_folder, project) = project(ModelFormat::ColmapBinary);
    diagnose_project(
        &project,
        scene,
        settings,
        &[backends::by_name(backend).unwrap()],
    )
}

fn diagnose_project(
    project: &Project,
    scene: &Scene,
    settings: &Settings,
    backends: &[&Backend],
) -> Vec<Finding> {
    let mut findings = examine(project, scene, settings, backends).findings;
    findings.retain(|finding| finding.check != "no-images");
    findings
}

fn found<'a>(findings: &'a [Finding], check: &str) -> &'a Finding {
    let found = findings.iter().find(|finding| finding.check == check);
    found.unwrap_or_else(|| panic!("no {check} in {findings:#?}"))
}

/// The detail of a view in a finding.
fn detail<'a>(finding: &'a Finding, view: &str) -> &'a str {
    let found = finding.views.iter().find(|of| of.name == view);
    &found
        .unwrap_or_else(|| panic!("no view {view} in {finding:#?}"))
        .why
}

/// The healthy block with additional views.
fn block_with(more: Vec<View>) -> Scene {
    scene_of(
        block(0.0, "n").into_iter().chain(more).collect(),
        square(0.0, 34),
        |_, _| false,
    )
}

#[test]
fn a_healthy_project_has_no_findings() {
    let (_folder, project) = project(ModelFormat::ColmapBinary);
    for backend in backends::BACKENDS {
        let order: Vec<&Backend> = std::iter::once(*backend)
            .chain(backends::BACKENDS.iter().copied())
            .collect();
        assert_eq!(
            diagnose_project(&project, &healthy(), &Settings::default(), &order),
            [],
            "{}",
            backend.name
        );
    }
}

#[test]
fn a_model_without_views() {
    let findings = diagnose(
        &scene_of(Vec::new(), square(0.0, 3), |_, _| false),
        "sure",
        &Settings::default(),
    );
    assert_eq!(
        (findings.len(), found(&findings, "no-views").severity),
        (1, Severity::Error)
    );
}

#[test]
fn a_view_without_shared_points() {
    let views = block(0.0, "n")
        .into_iter()
        .chain([down("far.jpg", 500.0, 0.0, 40.0)])
        .collect();
    let scene = scene_of(views, square(0.0, 34).chain(square(500.0, 20)), |_, _| {
        false
    });
    let findings = diagnose(&scene, "sure", &Settings::default());
    let finding = found(&findings, "too-few-partners");
    assert_eq!(
        (finding.views.len(), finding.severity),
        (1, Severity::Note),
        "one of many"
    );
    assert!(detail(finding, "far.jpg").contains("too few sparse points"));
}

#[test]
fn views_at_one_position() {
    let turned = |name: &str, aside: f64| view(name, [0.0, 0.0, 40.0], [aside, 3.0, 0.0]);
    let findings = diagnose(
        &block_with(vec![turned("p1.jpg", 2.0), turned("p2.jpg", -4.0)]),
        "sure",
        &Settings::default(),
    );
    let finding = found(&findings, "one-position");
    assert_eq!(detail(finding, "p1.jpg"), "with n12.jpg");
    assert_eq!(
        (detail(finding, "p2.jpg"), finding.severity),
        ("with n12.jpg", Severity::Note),
        "each has other partners"
    );

    let aside = block(300.0, "z").into_iter().take(1).chain([view(
        "z1.jpg",
        [284.0, -16.0, 40.0],
        [286.0, -16.0, 0.0],
    )]);
    let views = block(0.0, "n").into_iter().chain(aside).collect();
    let findings = diagnose(
        &scene_of(views, square(0.0, 34).chain(square(284.0, 34)), |_, _| {
            false
        }),
        "sure",
        &Settings::default(),
    );
    assert_eq!(
        found(&findings, "one-position").severity,
        Severity::Warning,
        "two have no others"
    );
    assert_eq!(
        found(&findings, "too-few-partners").severity,
        Severity::Warning,
        "and their points are lost"
    );

    let panorama = (0..6)
        .map(|i| turned(&format!("p{i}.jpg"), f64::from(i)))
        .collect();
    let findings = diagnose(
        &scene_of(panorama, square(0.0, 34), |_, _| false),
        "sure",
        &Settings::default(),
    );
    assert_eq!(found(&findings, "one-position").severity, Severity::Error);
    let alone = found(&findings, "too-few-partners");
    assert_eq!((alone.views.len(), alone.severity), (6, Severity::Error));
    assert!(detail(alone, "p3.jpg").contains("5 no baseline"));
}

/// Asserts that a limit of the backend is the reason why two views are not partners.
#[track_caller]
fn kept_apart(views: [View; 2], backend: &str, reason: &str) {
    let name = views[0].name.clone();
    let findings = diagnose(
        &scene_of(views.into(), square(0.0, 60), |_, _| false),
        backend,
        &Settings::default(),
    );
    let words = detail(found(&findings, "too-few-partners"), &name).to_owned();
    assert_eq!(words, format!("0 partners; refused: 1 {reason}"));
}

#[test]
fn the_reasons_of_refused_pairs() {
    let middle = || down("a.jpg", 0.0, 0.0, 40.0);
    kept_apart(
        [middle(), down("b.jpg", 1.2, 0.0, 40.0)],
        "colmap",
        "angle too small",
    );
    kept_apart(
        [middle(), down("b.jpg", 8.0, 0.0, 150.0)],
        "colmap",
        "scale too different",
    );
    let aside = |name: &str, x: f64| view(name, [x, 0.0, 30.0], [0.0, 0.0, 0.0]);
    kept_apart(
        [aside("a.jpg", -28.0), aside("b.jpg", 28.0)],
        "colmap",
        "angle too large",
    );
    kept_apart(
        [middle(), down("b.jpg", 0.0, 0.0, 35.0)],
        "sure",
        "motion along the line of sight",
    );
}

#[test]
fn fewer_partners_than_wanted() {
    let row = (0..4)
        .map(|i| down(&format!("{i}.jpg"), 8.0 * f64::from(i), 0.0, 40.0))
        .collect();
    let findings = diagnose(
        &scene_of(row, square(0.0, 60), |_, _| false),
        "colmap",
        &Settings::default(),
    );
    let finding = found(&findings, "fewer-partners-than-k");
    assert_eq!((finding.views.len(), finding.severity), (4, Severity::Note));
    assert!(detail(finding, "0.jpg").starts_with("3 partners"));
}

/// The healthy scene, where the points of view n12 that satisfy `copied` are copies that no other
/// view observes.
fn with_copies(copied: impl Fn(&Point3<f64>) -> bool) -> Scene {
    let mut scene = scene_of(block(0.0, "n"), square(0.0, 34), |name, point| {
        name == "n12.jpg" && copied(point)
    });
    for point in square(0.0, 34).filter(|point| copied(point)) {
        add_point(&mut scene, point, |name| name == "n12.jpg");
    }
    scene
}

#[test]
fn far_too_few_shared_points() {
    let hold = |point: &Point3<f64>| (point.x as i32) % 13 == 0 && (point.y as i32) % 13 == 0;
    let findings = diagnose(
        &with_copies(|point| !hold(point)),
        "sure",
        &Settings::default(),
    );
    let finding = found(&findings, "far-too-few-shared-points");
    assert_eq!(
        (finding.views.len(), finding.severity),
        (1, Severity::Warning)
    );
    assert!(detail(finding, "n12.jpg").contains(" points that n"));
}

#[test]
fn projections_say_nothing_of_links() {
    let mut scene = with_copies(|point| point.x > 0.0);
    scene.warnings = vec![ModelWarning::new(WarningKind::Projected, "no tracks")];
    let findings = diagnose(&scene, "sure", &Settings::default());
    assert_eq!(found(&findings, NO_TRACKS).severity, Severity::Note);
    let links = ["far-too-few-shared-points", "one-sided-links"];
    assert!(
        findings
            .iter()
            .all(|finding| !links.contains(&finding.check)),
        "{findings:#?}"
    );
}

#[test]
fn shared_points_on_one_side_only() {
    let findings = diagnose(
        &with_copies(|point| point.x > 0.0),
        "sure",
        &Settings::default(),
    );
    let finding = found(&findings, "one-sided-links");
    assert!(
        finding.views.iter().any(|of| of.name == "n12.jpg") && finding.views.len() < 4,
        "{finding:#?}"
    );
}

#[test]
fn a_model_in_parts() {
    let views = block(0.0, "n")
        .into_iter()
        .chain(block(500.0, "z").into_iter().take(10))
        .collect();
    let scene = scene_of(views, square(0.0, 34).chain(square(500.0, 34)), |_, _| {
        false
    });
    let findings = diagnose(&scene, "sure", &Settings::default());
    let finding = found(&findings, "model-in-parts");
    assert!(
        finding.what.contains("2 parts of 25, 10 views") && finding.views.len() == 10,
        "{finding:#?}"
    );
}

#[test]
fn implausible_units() {
    let mut far = healthy();
    far.points.iter_mut().for_each(|p| p.coords *= 1e5);
    far.views
        .iter_mut()
        .for_each(|v| v.cam_from_world.translation *= 1e5);
    let metric = Settings {
        units: Some(Units::Metric),
        ..Default::default()
    };
    assert_eq!(
        found(&diagnose(&far, "sure", &metric), "impossible-units").severity,
        Severity::Error
    );
    assert_eq!(
        diagnose(&far, "sure", &Settings::default()),
        [],
        "any unit is plausible without metres"
    );
    assert_eq!(diagnose(&healthy(), "sure", &metric), []);
    let scaled = |scale: f64| {
        let mut scene = healthy();
        scene.points.iter_mut().for_each(|p| p.coords *= scale);
        scene
            .views
            .iter_mut()
            .for_each(|v| v.cam_from_world.translation *= scale);
        diagnose(&scene, "sure", &metric)
    };
    // A pixel is 47 mm.
    assert_eq!(
        found(&scaled(1e-3), "impossible-units").severity,
        Severity::Warning
    );
    assert_eq!(
        found(&scaled(1e3), "impossible-units").severity,
        Severity::Warning
    );
    assert_eq!(
        found(&scaled(1e-5), "impossible-units").severity,
        Severity::Error
    );
    assert_eq!(scaled(0.01), [], "a model of a small thing");
    let utm = |offset| {
        let frame = FrameSettings {
            utm: Some("33N".into()),
            offset,
            ..Default::default()
        };
        diagnose(
            &healthy(),
            "sure",
            &Settings {
                frame,
                ..Default::default()
            },
        )
    };
    assert!(
        found(&utm(None), "impossible-frame")
            .what
            .contains("easting"),
        "the model's own coordinates"
    );
    assert_eq!(utm(Some([412_000.0, 5_400_000.0])), []);
    let target = TargetSettings {
        gsd: Some(5.0),
        ..Default::default()
    };
    let findings = diagnose(
        &healthy(),
        "sure",
        &Settings {
            target,
            ..Default::default()
        },
    );
    assert!(
        found(&findings, "impossible-target")
            .what
            .contains("times coarser")
    );
}

#[test]
fn impossible_cameras_and_poses() {
    let mut scene = healthy();
    scene.cameras[0] = Camera::new(
        1,
        CameraModel::Pinhole,
        1000,
        750,
        vec![24.0, 24.0, 500.0, 375.0],
    )
    .unwrap();
    let finding = diagnose(&scene, "sure", &Settings::default());
    assert!(
        found(&finding, "impossible-camera").what.contains("24.0"),
        "millimetres"
    );

    let mut scene = healthy();
    let turn = Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    let pose = &mut scene.views[3].cam_from_world;
    (pose.rotation, pose.translation) = (turn * pose.rotation, turn * pose.translation);
    let findings = diagnose(&scene, "sure", &Settings::default());
    assert_eq!(
        found(&findings, "points-behind-cameras").views,
        [ViewFinding::new("n03.jpg", "")]
    );

    let mut scene = healthy();
    scene
        .track_pixels
        .iter_mut()
        .for_each(|pixel| pixel[0] += 30.0);
    let findings = diagnose(&scene, "sure", &Settings::default());
    let finding = found(&findings, "large-reprojection-error");
    assert_eq!(
        (finding.severity, finding.views.len()),
        (Severity::Error, 25)
    );
    assert_eq!(detail(finding, "n04.jpg"), "30.0 px");
}

#[test]
fn images_of_another_model() {
    let (folder, mut project) = project(ModelFormat::ColmapBinary);
    let images = folder.path().join("images");
    fs::create_dir(&images).unwrap();
    project.images = Some(images.clone().into());
    let sure = [backends::by_name("sure").unwrap()];
    let findings = diagnose_project(&project, &healthy(), &Settings::default(), &sure);
    assert_eq!(found(&findings, "missing-images").views.len(), 25);
    image::RgbImage::new(20, 10)
        .save(images.join("n00.jpg"))
        .unwrap();
    let findings = diagnose_project(&project, &healthy(), &Settings::default(), &sure);
    assert!(
        found(&findings, "images-of-another-size")
            .what
            .contains("20 x 10 px")
    );
}

#[test]
fn images_that_cannot_be_read() {
    let (folder, mut project) = project(ModelFormat::ColmapBinary);
    let sure = [backends::by_name("sure").unwrap()];
    let of_healthy =
        |project: &Project| examine(project, &healthy(), &Settings::default(), &sure).findings;
    assert_eq!(
        found(&of_healthy(&project), "no-images").severity,
        Severity::Warning
    );
    let images = folder.path().join("images");
    fs::create_dir(&images).unwrap();
    project.images = Some(images.clone().into());
    let mut whole = std::io::Cursor::new(Vec::new());
    image::RgbImage::from_fn(1000, 750, |x, y| {
        image::Rgb([x as u8, y as u8, (x * y) as u8])
    })
    .write_to(&mut whole, image::ImageFormat::Jpeg)
    .unwrap();
    let whole = whole.into_inner();
    assert!(
        whole.len() > 100_000,
        "longer than the header that is read first"
    );
    let put = |number: usize, bytes: &[u8]| {
        fs::write(images.join(format!("n{number:02}.jpg")), bytes).unwrap()
    };
    (0..25).for_each(|number| put(number, &whole));
    image::RgbImage::new(1000, 750)
        .save_with_format(images.join("n09.jpg"), image::ImageFormat::Png)
        .unwrap();
    assert_eq!(
        of_healthy(&project),
        [],
        "a PNG by the name of a JPEG is read for what it is"
    );
    put(4, &[]);
    put(5, b"<html>not found</html>");
    put(6, &whole[..whole.len() / 2]);
    put(7, &whole[..1000]);
    put(8, &[&whole[..], &[7; 100_000]].concat());
    let findings = of_healthy(&project);
    let views = &found(&findings, "unreadable-images").views;
    let expected = [
        ("n04.jpg", "empty"),
        ("n05.jpg", "a web page, not the file itself"),
        ("n06.jpg", "truncated"),
        ("n07.jpg", "truncated"),
    ];
    assert_eq!(
        *views,
        expected.map(|(name, why)| ViewFinding::new(name, why)),
        "what follows the end is no harm"
    );
    assert_eq!(findings.len(), 1);
    let whole = fs::read(images.join("n09.jpg")).unwrap();
    put(9, &[&whole[..], &[7; 100_000]].concat());
    put(10, &whole[..whole.len() - 5]);
    let findings = of_healthy(&project);
    let views = &found(&findings, "unreadable-images").views;
    assert_eq!(
        views[4..],
        [ViewFinding::new("n10.jpg", "truncated")],
        "a PNG without the end of its last chunk"
    );
}

#[test]
fn masks_that_cannot_be_used() {
    let (folder, mut project) = project(ModelFormat::ColmapBinary);
    let sure = [backends::by_name("sure").unwrap()];
    let of_healthy =
        |project: &Project| examine(project, &healthy(), &Settings::default(), &sure).findings;
    let [images, masks] = ["images", "masks"].map(|name| folder.path().join(name));
    [&images, &masks]
        .into_iter()
        .for_each(|folder| fs::create_dir(folder).unwrap());
    (0..25).for_each(|number| {
        image::GrayImage::new(1000, 750)
            .save(images.join(format!("n{number:02}.jpg")))
            .unwrap()
    });
    project.images = Some(images.into());
    image::GrayImage::new(1000, 750)
        .save(masks.join("n00_mask.png"))
        .unwrap();
    assert!(
        found(&of_healthy(&project), "unused-masks")
            .cure
            .ends_with("masks/n00.jpg.png")
    );
    image::GrayImage::new(500, 375)
        .save(masks.join("n01.jpg.png"))
        .unwrap();
    assert_eq!(
        found(&of_healthy(&project), "stray-masks").views,
        [ViewFinding::new(
            masks.join("n00_mask.png").display().to_string(),
            ""
        )]
    );
    fs::remove_file(masks.join("n00_mask.png")).unwrap();
    assert_eq!(
        found(&of_healthy(&project), "black-masks").what,
        "masks that exclude all of the image: 1 of 1 that were read"
    );
    let white = |width, height| image::GrayImage::from_pixel(width, height, image::Luma([255]));
    white(500, 375).save(masks.join("n01.jpg.png")).unwrap();
    assert_eq!(of_healthy(&project), [], "a smaller copy is a mask");
    white(750, 1000).save(masks.join("n02.jpg.png")).unwrap();
    fs::write(masks.join("n03.jpg.png"), b"<html>not found</html>").unwrap();
    let whole = fs::read(masks.join("n01.jpg.png")).unwrap();
    fs::write(masks.join("n04.jpg.png"), &whole[..whole.len() - 20]).unwrap();
    let findings = of_healthy(&project);
    let views: Vec<&str> = found(&findings, "broken-masks")
        .views
        .iter()
        .map(|view| &*view.name)
        .collect();
    assert_eq!(views, ["n02.jpg", "n03.jpg", "n04.jpg"]);
    assert!(
        found(&findings, "broken-masks")
            .what
            .ends_with("not compared")
    );
    let mut settings = Settings::default();
    settings.confidence.source = ConfidenceSource::None;
    assert_eq!(
        examine(&project, &healthy(), &settings, &sure).findings,
        [],
        "no mask is read"
    );
}

#[test]
fn parts_that_the_model_leaves_out() {
    let mut scene = healthy();
    scene.unregistered = (0..2).map(|i| format!("x{i}.jpg")).collect();
    let text = "points3D.bin: 4 bytes after the last of 100 records are ignored";
    scene.warnings = vec![ModelWarning::new(WarningKind::Damaged, text)];
    let findings = diagnose(&scene, "sure", &Settings::default());
    assert_eq!(
        found(&findings, "unregistered-images").severity,
        Severity::Note,
        "2 of 27"
    );
    assert!(
        found(&findings, "model-not-as-it-should-be")
            .what
            .contains("points3D.bin: 4 bytes")
    );
    scene.unregistered = (0..50).map(|i| format!("x{i:02}.jpg")).collect();
    let findings = diagnose(&scene, "sure", &Settings::default());
    let finding = found(&findings, "unregistered-images");
    assert_eq!(
        (finding.severity, finding.views.len()),
        (Severity::Warning, 50)
    );
    assert!(finding.what.starts_with("50 of 75 images"));
}

#[test]
fn several_sub_models() {
    let folder = tempfile::tempdir().unwrap();
    let part = |views: usize| {
        scene_of(
            block(0.0, "n").into_iter().take(views).collect(),
            square(0.0, 34),
            |_, _| false,
        )
    };
    let severity = |others: Scene| {
        for (number, scene) in [("0", healthy()), ("1", others)] {
            fs::create_dir_all(folder.path().join("sparse").join(number)).unwrap();
            for (name, bytes) in colmap_bin::write(&ColmapModel::from_scene(&scene)) {
                fs::write(folder.path().join("sparse").join(number).join(name), bytes).unwrap();
            }
        }
        let project = Project::open(folder.path(), None).unwrap();
        let scene = project.read_scene().unwrap();
        let findings = diagnose_project(
            &project,
            &scene,
            &Settings::default(),
            &[backends::by_name("sure").unwrap()],
        );
        assert_eq!(findings.len(), 1, "{findings:#?}");
        (findings[0].check, findings[0].severity)
    };
    let apart = |views: usize| {
        let mut scene = part(views);
        scene
            .views
            .iter_mut()
            .for_each(|view| view.name.insert(0, 'x'));
        scene
    };
    assert_eq!(
        severity(apart(2)),
        ("other-sub-models", Severity::Note),
        "the usual splinter"
    );
    assert_eq!(severity(apart(12)), ("other-sub-models", Severity::Warning));
    assert_eq!(
        severity(part(12)),
        ("model-copies", Severity::Note),
        "the same images in other coordinates"
    );
}

#[test]
fn a_model_without_common_points() {
    let views = |scene: &Scene| diagnose(scene, "sure", &Settings::default());
    for scene in [
        scene_of(block(0.0, "n"), std::iter::empty(), |_, _| false),
        scene_of(
            vec![down("a.jpg", 0.0, 0.0, 40.0)],
            square(0.0, 20),
            |_, _| false,
        ),
    ] {
        let findings = views(&scene);
        assert_eq!(
            found(&findings, "no-common-points").severity,
            Severity::Error
        );
        assert_eq!(findings.len(), 1, "no finding per view: {findings:#?}");
    }
    // A model without points gets the reader's advice alone, whatever the backend.
    let mut scene = scene_of(block(0.0, "n"), std::iter::empty(), |_, _| false);
    scene.warnings =
        vec![ModelWarning::new(WarningKind::NoPoints, "no points").with_cure("export")];
    for backend in ["colmap", "mvsnet", "gipuma"] {
        let findings = diagnose(&scene, backend, &Settings::default());
        assert_eq!((findings.len(), &*findings[0].cure), (1, "export"));
    }
}

#[test]
fn a_view_in_a_wrong_place() {
    let mut scene = healthy();
    scene.views[8].cam_from_world.translation.x += 2.0;
    let findings = diagnose(&scene, "sure", &Settings::default());
    let finding = found(&findings, "large-reprojection-error");
    assert_eq!(
        (finding.views.len(), finding.severity),
        (1, Severity::Warning)
    );
    assert!(detail(finding, "n08.jpg").ends_with(" px"));
}

#[test]
fn views_without_points_are_not_held_against_their_neighbours() {
    let without = [
        "n06.jpg", "n07.jpg", "n08.jpg", "n11.jpg", "n13.jpg", "n16.jpg", "n17.jpg", "n18.jpg",
    ];
    let scene = scene_of(block(0.0, "n"), square(0.0, 34), |name, _| {
        without.contains(&name)
    });
    let findings = diagnose(&scene, "sure", &Settings::default());
    let few = findings
        .iter()
        .filter(|finding| finding.check == "far-too-few-shared-points");
    assert_eq!(few.count(), 0, "{findings:#?}");
}

#[test]
fn distorted_cameras_are_undistorted_first() {
    let mut scene = healthy();
    scene.cameras[0] = Camera::new(
        1,
        CameraModel::SimpleRadial,
        1000,
        750,
        vec![850.0, 500.0, 375.0, 1e-9],
    )
    .unwrap();
    let findings = diagnose(&scene, "colmap", &Settings::default());
    assert!(
        found(&findings, "distorted-images")
            .cure
            .starts_with("viewrank undistort ")
    );
    assert_eq!(
        diagnose(&scene, "micmac", &Settings::default()),
        [],
        "MicMac has its own calibrations"
    );
}
