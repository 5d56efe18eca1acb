//! A project for each trap of a backend.

use std::{fs, path::Path};

use nalgebra::Vector3;

use super::{block, diagnose, diagnose_project, found, healthy, project, scene_of, square};
use crate::{
    apps::doctor::{Finding, Severity, ViewFinding},
    backends,
    config::Settings,
    io::{
        formats::{colmap::ColmapModel, colmap_text},
        project::{ModelFormat, Project},
    },
    model::scene::Scene,
};

/// The trap that a backend reports for a project whose first views have these names.
#[track_caller]
fn trapped(backend: &str, names: &[&str], trap: &str) -> Finding {
    let mut scene = healthy();
    scene
        .views
        .iter_mut()
        .zip(names)
        .for_each(|(view, name)| view.name = (*name).into());
    let findings = diagnose(&scene, backend, &Settings::default());
    let finding = found(&findings, trap);
    assert!(
        !finding.cure.is_empty()
            && finding.backends == [backend]
            && finding.severity == Severity::Warning
    );
    finding.clone()
}

#[test]
fn names_that_backends_cannot_take() {
    for name in ["a,b.jpg", "a;b.jpg", "#1.jpg", " 1.jpg"] {
        assert_eq!(
            trapped("colmap", &[name], "colmap-name").views[0].name,
            name
        );
    }
    trapped("sure", &["#1.jpg"], "sure-name");
    trapped("sgm", &["a\tb.jpg"], "sgm-name");
    trapped("sure", &["a/1.jpg", "a_1.tif"], "sure-same-stem");
    trapped("micmac", &["a b.jpg"], "micmac-name");
    trapped("micmac", &["a/b.jpg"], "micmac-name");
    trapped("micmac", &["a.jpg", "a.png"], "micmac-same-stem");
    trapped("openmvs", &["a\\1.jpg"], "openmvs-backslash-name");
    trapped("mve", &["1.tif"], "mve-extension");
    trapped("pmvs", &["1.webp"], "pmvs-extension");
    trapped("splat", &["a/1.jpg", "b/1.x.jpg"], "splat-duplicate-names");
    assert_eq!(
        trapped(
            "metashape",
            &["a/1.jpg", "b/1.jpg"],
            "metashape-duplicate-labels"
        )
        .views
        .len(),
        2
    );
    trapped(
        "realityscan",
        &["1.jpg", "1.png"],
        "realityscan-xmp-same-stem",
    );
}

#[test]
fn a_view_without_points_stops_some_backends() {
    let scene = scene_of(block(0.0, "n"), square(0.0, 34), |name, _| {
        name == "n07.jpg"
    });
    for (backend, trap) in [
        ("colmap", "colmap-key-view-without-points"),
        ("gipuma", "gipuma-depth-range-mandatory"),
        ("mvsnet", "mvsnet-depth-range"),
    ] {
        let findings = diagnose(&scene, backend, &Settings::default());
        assert_eq!(
            found(&findings, trap).views,
            [ViewFinding::new("n07.jpg", "")]
        );
    }
}

/// The traps of a project whose files `prepare` creates.
fn traps_in(
    format: ModelFormat,
    backend: &str,
    scene: &Scene,
    prepare: impl Fn(&Path, &mut Project),
) -> Vec<Finding> {
    let (folder, mut project) = project(format);
    prepare(folder.path(), &mut project);
    diagnose_project(
        &project,
        scene,
        &Settings::default(),
        &[backends::by_name(backend).unwrap()],
    )
}

fn write(path: std::path::PathBuf, text: &str) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(path, text).unwrap();
}

#[test]
fn leftover_files() {
    let healthy = healthy();
    let dense = "opensfm/undistorted/openmvs/scene_dense_dense_filtered.ply";
    let findings = traps_in(ModelFormat::OpenSfm, "odm", &healthy, |root, _| {
        write(root.join(dense), "")
    });
    assert!(
        found(&findings, "odm-existing-model-skips-stage")
            .cure
            .starts_with("rm ")
    );

    let scene = "opensfm/undistorted/openmvs/scene.mvs";
    let findings = traps_in(ModelFormat::OpenSfm, "odm", &healthy, |root, _| {
        write(root.join(scene), "")
    });
    assert!(
        found(&findings, "odm-existing-scene")
            .cure
            .ends_with("scene.mvs")
    );

    let beside = |text: &Scene| {
        traps_in(ModelFormat::ColmapBinary, "colmap", &healthy, |root, _| {
            for (name, bytes) in colmap_text::write(&ColmapModel::from_scene(text)).unwrap() {
                fs::write(root.join("sparse/0").join(name), bytes).unwrap();
            }
        })
    };
    assert_eq!(
        beside(&healthy),
        [],
        "the same model in both forms, the text the newer one"
    );
    let mut moved = healthy.clone();
    moved.views[3].cam_from_world.translation.x += 0.1;
    assert!(
        found(&beside(&moved), "colmap-bin-beats-txt")
            .cure
            .contains("rm ")
    );
    let mut renamed = healthy.clone();
    renamed.views[3].name = "n03b.jpg".into();
    assert!(
        found(&beside(&renamed), "colmap-bin-beats-txt")
            .cure
            .contains("rm ")
    );

    let poses = "<x xcr:PosePrior=\"initial\"/>";
    let findings = traps_in(
        ModelFormat::ColmapBinary,
        "realityscan",
        &healthy,
        |root, project| {
            healthy
                .views
                .iter()
                .for_each(|view| write(root.join("images").join(&view.name), ""));
            write(root.join("images/n00.xmp"), poses);
            project.images = Some(root.join("images").into());
        },
    );
    assert_eq!(
        found(&findings, "realityscan-existing-xmp-poses")
            .views
            .len(),
        1
    );
}

#[test]
fn models_that_lose_something_in_their_format() {
    let mut named = healthy();
    named.views[0].name = "a b.jpg".into();
    let findings = traps_in(ModelFormat::ColmapText, "colmap", &named, |_, _| {});
    assert_eq!(
        found(&findings, "colmap-text-model-blank-name").views[0].name,
        "a b.jpg"
    );
    assert_eq!(
        traps_in(ModelFormat::ColmapBinary, "colmap", &named, |_, _| {}),
        []
    );

    let mut far = healthy();
    let offset = Vector3::new(500_000.0, 5_400_000.0, 0.0);
    far.points.iter_mut().for_each(|p| *p += offset);
    for view in &mut far.views {
        let pose = &mut view.cam_from_world;
        pose.translation -= pose.rotation * offset;
    }
    let workspace =
        |root: &Path, project: &mut Project| project.dense_workspace = Some(root.join("dense"));
    let findings = traps_in(ModelFormat::ColmapBinary, "colmap", &far, workspace);
    assert!(
        found(&findings, "colmap-far-from-origin")
            .cure
            .contains("--out")
    );
    assert_eq!(
        traps_in(ModelFormat::ColmapBinary, "colmap", &far, |_, _| {}),
        [],
        "the export moves it"
    );
    assert_eq!(
        traps_in(ModelFormat::ColmapBinary, "colmap", &healthy(), workspace),
        []
    );
    let findings = traps_in(ModelFormat::OpenMvs, "openmvs", &far, |_, _| {});
    assert!(
        found(&findings, "openmvs-far-from-origin")
            .what
            .contains("5400")
    );
    assert_eq!(
        traps_in(ModelFormat::ColmapBinary, "openmvs", &far, |_, _| {}),
        []
    );
}

#[test]
fn finished_maps_of_another_plan() {
    let (folder, mut project) = project(ModelFormat::ColmapBinary);
    project.dense_workspace = Some(folder.path().join("dense"));
    let put = |name: &str| {
        let path = folder.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, "").unwrap();
    };
    let traps = |backend: &str| {
        diagnose_project(
            &project,
            &healthy(),
            &Settings::default(),
            &[backends::by_name(backend).unwrap()],
        )
    };
    for (backend, trap, map) in [
        (
            "colmap",
            "colmap-stale-maps-skipped",
            "dense/stereo/depth_maps/a/n00.jpg.photometric.bin",
        ),
        ("openmvs", "openmvs-existing-dmap-kept", "depth0001.dmap"),
    ] {
        assert!(
            traps(backend).iter().all(|finding| finding.check != trap),
            "{backend}"
        );
        put(map);
        assert!(
            found(&traps(backend), trap).what.starts_with("1 finished"),
            "{backend}"
        );
    }
    let write = |name: &str, text: &str| {
        put(name);
        fs::write(folder.path().join(name), text).unwrap();
    };
    write(
        "dense/stereo/viewrank/marks.tsv",
        "ab\tcd\ta/n00.jpg.photometric.bin\n",
    );
    assert!(
        found(&traps("colmap"), "colmap-stale-maps-skipped")
            .what
            .starts_with("1 finished"),
        "listed, but made otherwise"
    );
    write("dense/stereo/viewrank/done/ab", "cd\n");
    assert!(
        traps("colmap")
            .iter()
            .all(|finding| finding.check != "colmap-stale-maps-skipped"),
        "made from the list"
    );
}
