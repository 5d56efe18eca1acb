//! Every format that is read and written gives the same scene back, whatever the scene.

use nalgebra::{Point3, Rotation3, Vector3};
use proptest::{collection::vec, prelude::*, sample::Index};
use viewrank::backends::{ExportOptions, Selection, by_name};
use viewrank_core::model::{
    camera::{Camera, CameraModel},
    cluster::{MapScale, RankedCluster},
    scene::{CameraIndex, Pose, Scene, View, ViewIndex},
};
use viewrank_io::{
    formats::{Bytes, alicevision, colmap::ColmapModel, colmap_bin, colmap_text, openmvs, sure},
    output::Contents,
    project::{ModelFormat, ModelLocation, Project, ProjectKind},
};

/// Scenes with one to three cameras, ids out of order, and an origin that may be that of a map
/// projection.
fn scenes(pinhole: bool) -> impl Strategy<Value = Scene> {
    let cameras = vec(
        (100u64..5000, 100u64..5000, 50.0..9000.0f64, -0.3..0.3f64),
        1..4,
    );
    let views = vec((any::<[i16; 3]>(), any::<[i16; 3]>(), any::<Index>()), 2..7);
    let points = vec(
        (
            any::<[i16; 3]>(),
            vec((any::<Index>(), -50.0..6000.0f64), 1..6),
        ),
        0..12,
    );
    let origin = prop_oneof![
        Just(Vector3::zeros()),
        Just(Vector3::new(431_234.5, 5_412_345.25, -31.125))
    ];
    (cameras, views, points, origin).prop_map(move |(cameras, views, points, origin)| {
        let mut scene = Scene {
            track_offsets: vec![0],
            ..Scene::default()
        };
        for (i, (width, height, f, k)) in (1..).zip(cameras) {
            let centre = [width as f64 * 0.51, height as f64 * 0.48];
            let [cx, cy] = centre;
            let (model, params) = match (pinhole, i % 3) {
                (true, _) => (CameraModel::Pinhole, vec![f, f * 1.01, cx, cy]),
                (_, 0) => (
                    CameraModel::OpenCvFisheye,
                    vec![f, 1.01 * f, cx, cy, k, -k * k, 0.1 * k, 0.0],
                ),
                (_, 1) => (CameraModel::Radial, vec![f, cx, cy, k, -k * k]),
                _ => (
                    CameraModel::FullOpenCv,
                    vec![
                        f,
                        0.99 * f,
                        cx,
                        cy,
                        k,
                        -k * k,
                        1e-3,
                        -2e-3,
                        0.01,
                        0.02,
                        0.0,
                        -0.01,
                    ],
                ),
            };
            scene
                .cameras
                .push(Camera::new(10 - i, model, width, height, params).unwrap());
        }
        let count = views.len() as u32;
        for (i, (angles, centre, camera)) in (0..).zip(views) {
            let angles = angles.map(|a| f64::from(a) / 6000.0);
            let rotation = Rotation3::new(Vector3::from(angles));
            let centre = Vector3::from(centre.map(|c| f64::from(c) / 64.0)) + origin;
            scene.views.push(View {
                name: format!("flight {}/image ö {i}.jpg", i % 2),
                image_id: 3 * (count - i),
                file_position: i,
                camera: CameraIndex(camera.index(scene.cameras.len()) as u32),
                cam_from_world: Pose {
                    rotation,
                    translation: -(rotation * centre),
                },
            });
        }
        scene.views.sort_by(|a, b| a.name.cmp(&b.name));
        for (id, (x, track)) in (5..).zip(points) {
            scene.points.push(Point3::from(
                Vector3::from(x.map(|c| f64::from(c) / 16.0)) + origin,
            ));
            scene.point_ids.push(id * id);
            scene.colours.push([id as u8, 200, 7]);
            let mut track: Vec<(u32, f64)> = track
                .iter()
                .map(|(v, x)| (v.index(count as usize) as u32, *x))
                .collect();
            track.sort_by_key(|(v, _)| *v);
            track.dedup_by_key(|(v, _)| *v);
            for (view, x) in track {
                scene.track_views.push(ViewIndex(view));
                scene.track_pixels.push([x, 0.5 * x]);
            }
            scene.track_offsets.push(scene.track_views.len());
        }
        scene
    })
}

fn reread(files: &[(&str, Vec<u8>)]) -> Scene {
    let file = |stem: &str| {
        files
            .iter()
            .find(|(name, _)| name.starts_with(stem))
            .map_or(&[][..], |(_, b)| b)
    };
    let bytes = Bytes {
        cameras: file("cameras"),
        images: file("images"),
        points3d: file("points3D"),
        ..Bytes::default()
    };
    let text = files[0].0.ends_with(".txt");
    let model = if text {
        colmap_text::read(&bytes)
    } else {
        colmap_bin::read(&bytes)
    };
    model.unwrap().scene().unwrap()
}

/// The same cameras, poses, points and observations; `apart`: of camera centres, in units.
fn assert_same(a: &Scene, b: &Scene, apart: f64) -> Result<(), TestCaseError> {
    prop_assert_eq!(a.views.len(), b.views.len());
    for (v, (one, other)) in a.views.iter().zip(&b.views).enumerate() {
        prop_assert_eq!((&one.name, one.image_id), (&other.name, other.image_id));
        let v = ViewIndex(v as u32);
        let (one_camera, other_camera) = (a.camera_of(v), b.camera_of(v));
        prop_assert_eq!(one_camera.model(), other_camera.model());
        prop_assert_eq!(
            (one_camera.width, one_camera.height),
            (other_camera.width, other_camera.height)
        );
        for (p, q) in one_camera.params().iter().zip(other_camera.params()) {
            prop_assert!((p - q).abs() <= 1e-12 * p.abs().max(1.0), "{p} {q}");
        }
        let (p, q) = (&one.cam_from_world, &other.cam_from_world);
        prop_assert!((p.rotation.matrix() - q.rotation.matrix()).norm() < 1e-14 * 10.0);
        prop_assert!(
            (p.centre() - q.centre()).norm() < apart,
            "{} {}",
            p.centre(),
            q.centre()
        );
    }
    prop_assert_eq!(&a.points, &b.points);
    prop_assert_eq!((&a.point_ids, &a.colours), (&b.point_ids, &b.colours));
    prop_assert_eq!(
        (&a.track_offsets, &a.track_views),
        (&b.track_offsets, &b.track_views)
    );
    prop_assert_eq!(&a.track_pixels, &b.track_pixels);
    Ok(())
}

/// A project whose model is on no disk.
fn project() -> Project {
    Project {
        root: "/nowhere".into(),
        home: "/nowhere".into(),
        named: "/nowhere".into(),
        kind: ProjectKind::BareModel,
        model: ModelLocation::new(ModelFormat::OpenMvs, "/nowhere/scene.mvs"),
        model_is_named: false,
        other_models: Vec::new(),
        images: Some("/nowhere/images".into()),
        originals: None,
        dense_workspace: None,
        model_stamps: Vec::new(),
    }
}

/// The whole scene in one cluster, as a backend writes it, and the origin that its coordinates
/// count from.
fn exported(scene: &Scene, backend: &str, path: &str) -> (Vec<u8>, Vector3<f64>) {
    let mut views: Vec<ViewIndex> = scene.view_indices().collect();
    let key = views.remove(0);
    let clusters = [RankedCluster {
        key,
        partners: views,
        scale: MapScale::Full,
        share: 1.0,
    }];
    let project = project();
    let image_faults = &Default::default();
    let selection = Selection {
        project: &project,
        scene,
        clusters: &clusters,
        image_scale: 1.0,
        own_size: false,
        planned_for: backend,
        image_faults,
        test_every: None,
    };
    let export = by_name(backend)
        .unwrap()
        .export(&selection, &ExportOptions::default())
        .unwrap();
    match &export.files.files[path] {
        Contents::Bytes(bytes) => (bytes.clone(), export.record.origin.into()),
        other => panic!("{path} is {other:?}"),
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn colmap_binary(scene in scenes(false)) {
        // A quaternion and a translation: of map coordinates the centre keeps nanometres.
        assert_same(&reread(&colmap_bin::write(&ColmapModel::from_scene(&scene))), &scene, 1e-8)?;
    }

    #[test]
    fn colmap_text(mut scene in scenes(false)) {
        let refused = colmap_text::write(&ColmapModel::from_scene(&scene));
        prop_assert!(refused.is_err(), "COLMAP's text form ends a name at its first blank");
        scene.views.iter_mut().for_each(|v| v.name = v.name.replace(' ', "_"));
        assert_same(&reread(&colmap_text::write(&ColmapModel::from_scene(&scene)).unwrap()), &scene, 1e-8)?;
    }

    #[test]
    fn sure_orientations(scene in scenes(true)) {
        for view in scene.view_indices() {
            let (camera, pose) = (scene.camera_of(view), &scene.view(view).cam_from_world);
            let text = sure::write(scene.name(view), camera, pose).unwrap();
            let read = sure::read(text.as_bytes(), 1).unwrap();
            prop_assert_eq!(&read.image, scene.name(view));
            prop_assert_eq!((read.camera.width, read.camera.height), (camera.width, camera.height));
            for (p, q) in camera.params().iter().zip(read.camera.params()) {
                prop_assert!((p - q).abs() < 1e-9);
            }
            let again = read.cam_from_world.pose().unwrap();
            prop_assert!((again.rotation.matrix() - pose.rotation.matrix()).norm() < 1e-12);
            prop_assert!((again.centre() - pose.centre()).norm() < 1e-7);
        }
    }

    /// AliceVision's file names are those of its prepared images; what the key view observes comes
    /// back.
    #[test]
    fn alicevision_scene_files(scene in scenes(true)) {
        let (bytes, origin) = exported(&scene, "alicevision", "clusters/0001.sfm");
        let scene = scene.moved(origin);
        let read = alicevision::read(&bytes).unwrap().scene().unwrap();
        prop_assert_eq!(read.views.len(), scene.views.len());
        for view in scene.view_indices() {
            let (ours, camera) = (scene.view(view), scene.camera_of(view));
            let found = read.view_indices().find(|v| read.view(*v).image_id == ours.image_id).unwrap();
            for (p, q) in camera.params().iter().zip(read.camera_of(found).params()) {
                prop_assert!((p - q).abs() < 1e-8, "{p} {q}");
            }
            let again = &read.view(found).cam_from_world;
            prop_assert!((again.rotation.matrix() - ours.cam_from_world.rotation.matrix()).norm() < 1e-12);
            let centre = again.centre();
            prop_assert!((centre - ours.cam_from_world.centre()).norm() < 1e-7);
        }
        for (p, x) in read.points.iter().enumerate() {
            let original = scene.points.iter().position(|y| x == y).unwrap();
            for i in read.track_offsets[p]..read.track_offsets[p + 1] {
                let id = read.view(read.track_views[i]).image_id;
                let of_view = |o: &usize| scene.view(scene.track_views[*o]).image_id == id;
                let pixels = (scene.track_offsets[original]..scene.track_offsets[original + 1]).filter(of_view);
                let off = |p: [f64; 2]| (p[0] - read.track_pixels[i][0]).hypot(p[1] - read.track_pixels[i][1]);
                prop_assert!(pixels.map(|o| off(scene.track_pixels[o])).any(|off| off < 1e-9));
            }
        }
    }

    /// What is written into a scene of OpenMVS, up to its numbers of single precision.
    #[test]
    fn openmvs_scenes(scene in scenes(true)) {
        let (bytes, origin) = exported(&scene, "openmvs", "clusters/0001.mvs");
        let mut mvs = openmvs::Mvs::read(&bytes).unwrap();
        prop_assert_eq!(openmvs::Mvs::read(&mvs.write()).unwrap(), mvs.clone());
        // The map is made in unfinished/NAME.
        for image in &mut mvs.images {
            image.name = image.name.strip_prefix(b"../../").unwrap().to_vec();
        }
        let read = mvs.model(&|_| None).unwrap().scene().unwrap();
        for view in scene.view_indices() {
            let name = format!("images/{}", scene.name(view));
            let found = read.find(&name).unwrap();
            for (p, q) in scene.camera_of(view).params().iter().zip(read.camera_of(found).params()) {
                prop_assert!((p - q).abs() < 1e-9, "{p} {q}");
            }
            let again = &read.view(found).cam_from_world;
            let rotation = scene.view(view).cam_from_world.rotation;
            prop_assert!((again.rotation.matrix() - rotation.matrix()).norm() < 1e-12);
            let centre = again.centre() + origin;
            prop_assert!((centre - scene.view(view).cam_from_world.centre()).norm() < 1e-7);
        }
    }
}
