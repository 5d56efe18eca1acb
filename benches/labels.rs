//! Are the labels right that the confidence learns from (method 7.3)? Against exact depth.
//!
//!     cargo bench --bench labels -- PROJECT DEPTH_MAPS CLUSTERS REFERENCE
//!
//! DEPTH_MAPS: a folder of finished maps, made for the clusters of the file CLUSTERS; REFERENCE: exact depth, a .npy per view. A positive label is right where the
//! map is within 3 a_d of the exact depth (method 8), a negative one where it is not, or has none where there is something to measure;
//! those without exact depth are counted apart. Printed: how many labels there are, and what share of them is right.

use std::{collections::BTreeMap, path::Path};

use viewrank::internals::{
    backends,
    config::{CommandLineSettings, Configuration, Files},
    depthmaps::{self, DepthMap, DepthMapFile},
    evaluate,
    fulfilment::Model,
    learn::{Label, TrainingProject},
    progress::NoWatcher,
    project::Project,
};

type Fallible<T> = Result<T, Box<dyn std::error::Error>>;

/// In a_d, as method 8.
const RIGHT_WITHIN: f64 = 3.0;
/// Reference depths that differ by more, as a share, are of two surfaces.
const SAME_SURFACE: f64 = 0.02;

fn main() -> Fallible<()> {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    let [project, maps, clusters, reference] = match &arguments[..] {
        // Run with all other benchmarks.
        [] => return Ok(()),
        [project, maps, clusters, reference] => [project, maps, clusters, reference],
        _ => return Err("give PROJECT DEPTH_MAPS CLUSTERS REFERENCE".into()),
    };
    let project = Project::open(Path::new(project), None)?;
    let files = Files { user: None, root: None, project: Some(project.root.join("viewrank.toml")) };
    let mut settings = Configuration::load(&files, CommandLineSettings::default(), backends::canonical_name)?.settings;
    settings.backends = vec!["sgm".into()];
    settings.confidence.source = "geometric".into();
    let plan = backends::plan(&project, &settings, &NoWatcher)?;
    let clusters = evaluate::clusters::read(Path::new(clusters), &plan.stages.scene)?;
    let found = depthmaps::find(Path::new(maps), &plan.stages.scene)?.into_complete()?;
    let exact = depthmaps::find(Path::new(reference), &plan.stages.scene)?.into_complete()?;
    let lesson = TrainingProject {
        name: "labels".into(),
        model: plan.stages.model(),
        candidates: &plan.stages.candidates,
        clusters: evaluate::tried(Path::new(maps), &found.maps, &plan.stages.scene, &clusters)?,
        maps: found.maps,
        images: None,
    };
    let of_map = |file: &DepthMapFile, labels: Vec<Label>| {
        let exact = exact.maps.iter().find(|exact| exact.view == file.view)?;
        let map = depthmaps::read_of_view(file, &plan.stages.scene).ok()?;
        let exact = depthmaps::read_of_view(exact, &plan.stages.scene).ok()?;
        Some(count(&lesson.model, file, &map, &exact, &labels))
    };
    let mut all: BTreeMap<&str, [u64; 2]> = BTreeMap::new();
    for (kind, [labels, right]) in lesson.for_each_map(of_map, &NoWatcher)?.into_iter().flatten().flatten() {
        let sum = all.entry(kind).or_default();
        *sum = [sum[0] + labels, sum[1] + right];
    }
    for (kind, [labels, right]) in all {
        println!("{kind:28} {labels:9} labels, {:.3} of them right", right as f64 / labels as f64);
    }
    Ok(())
}

/// By kind of label: how many, and how many of them are right.
fn count(
    model: &Model,
    file: &DepthMapFile,
    map: &DepthMap,
    exact: &DepthMap,
    labels: &[Label],
) -> BTreeMap<&'static str, [u64; 2]> {
    let camera = model.scene.camera_of(file.view);
    let mut counts: BTreeMap<&str, [u64; 2]> = BTreeMap::new();
    for label in labels {
        let [column, row] = [(label.x, map.width), (label.y, map.height)].map(|(at, size)| (at * size as f32) as u32);
        let position = map.image_position(camera, column, row);
        let truth = exact.interpolated(camera, &position, SAME_SURFACE);
        let along = camera.ray(&position).map_or(1.0, |ray| 1.0 / ray.z);
        let limit = RIGHT_WITHIN * model.target.accuracy(model.visibility.triangles[label.row]);
        let is_near =
            |truth: f64| map.depth_at(column, row).is_some_and(|depth| (depth - truth).abs() * along <= limit);
        let is_right = truth.is_some_and(|truth| is_near(truth) == label.success);
        let kinds: &[&str] = match (label.success, label.measured) {
            // The sky, edges, and what moves.
            _ if truth.is_none() => &["no exact depth"],
            (true, _) => &["positive"],
            (false, true) => &["negative", "negative, with a depth"],
            (false, false) => &["negative", "negative, without a depth"],
        };
        for kind in kinds {
            let [labels, right] = counts.entry(kind).or_default();
            *labels += 1;
            *right += u64::from(is_right);
        }
    }
    counts
}
