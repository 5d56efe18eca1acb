//! The plain list of neighbours for a `scene.mvs` that is there already.
//!
//! It replaces the neighbours of the listed images and nothing else: other images are computed too, and for the listed ones the search
//! range is 0.1 to 100 units whatever the scene. So the depths are checked, and on request a copy of the scene is made at a size that
//! fits; this copy has no points, so that only the listed images can be computed.

use std::path::Path;

use nalgebra::{Matrix3, Vector3};

use super::{OpenMvs, dense_config, resolution};
use crate::{
    backends::{BackendError, Export, ExportOptions, ExportRecord, Selection, capped_scale},
    formats::openmvs::{Mvs, NO_POSE},
    output::Contents,
    project::ProjectError,
    scene::ViewIndex,
    shell::{quoted, quoted_path},
};

/// Depths that OpenMVS searches for an image with given neighbours.
const SEARCHED: [f64; 2] = [0.1, 100.0];
/// Where the median depth of the key views goes.
const SCALED_DEPTH: f64 = 10.0;

pub fn export(selection: &Selection, options: &ExportOptions, path: &Path) -> Result<Export, BackendError> {
    let mvs = read(path)?;
    let positions = positions(selection, &mvs, path)?;
    let depths: Vec<Depths> =
        selection.clusters.iter().map(|c| Depths::of(&mvs, positions[c.key.at()], selection, c.key)).collect();
    let scale = if options.scale { SCALED_DEPTH / median(depths.iter().map(|d| d.median)) } else { 1.0 };
    check_depths(&depths, scale, options.scale)?;

    let mut record = ExportRecord::new(&OpenMvs, selection, |v| positions[v.at()].to_string());
    record.made_for = "OpenMVS v2.0 to v2.3 and develop (run with v2.3.0)".into();
    record.pixel_shift = -0.5;
    record.scale = scale;
    let mut files = options.file_set(&OpenMvs, selection);
    let list = |c: &crate::backends::RankedCluster| {
        let views = std::iter::once(&c.key).chain(&c.partners);
        views.map(|v| positions[v.at()].to_string()).collect::<Vec<_>>().join(" ") + "\n"
    };
    files.add_text("neighbours.txt", selection.clusters.iter().map(list).collect::<String>());
    files.add_text("dense.cfg", dense_config(selection));
    let folder = std::path::absolute(path).ok().and_then(|p| p.parent().map(Path::to_path_buf)).unwrap_or_default();
    let size = resolution(selection);
    let densify = |scene: &str, fuse: usize| {
        format!(
            "DensifyPointCloud -w {} -i {scene} -o \"$PWD/dense.mvs\" --view-neighbors-file \"$PWD/neighbours.txt\" \
             --dense-config-file \"$PWD/dense.cfg\" --resolution-level 0 --min-resolution 16 --max-resolution {size} --number-views 0 \
             --geometric-iters 0 --number-views-fuse {fuse}",
            quoted_path(&folder)
        )
    };
    if options.scale {
        files.add("scaled.mvs", Contents::Bytes(scaled(mvs, scale).write()));
        let unscale = include_bytes!("../../../integrations/openmvs/unscale.py");
        files.add("unscale.py", Contents::Script(unscale.to_vec()));
        record.way = "list of neighbours, with a scaled copy of the scene without points".into();
        record.commands =
            vec![densify("\"$PWD/scaled.mvs\"", 1), format!("python3 unscale.py dense.ply dense_unscaled.ply {scale}")];
        record.fusion = "number-views-fuse 1: partners have no depth maps that could agree".into();
    } else {
        record.way = "list of neighbours for an existing scene".into();
        record.commands = vec![densify(&quoted(&path.file_name().unwrap_or_default().to_string_lossy()), 2)];
        record.not_honoured.push(
            "only the key views: images that are not listed get depth maps too, with OpenMVS's own neighbours".into(),
        );
        record.fusion = "number-views-fuse 2".into();
    }
    record.not_honoured.push("the rank order".into());
    record.note_scale(selection, capped_scale(size));
    files.add_text("export.json", record.to_json());
    Ok(Export { files, record })
}

fn read(path: &Path) -> Result<Mvs, BackendError> {
    let bytes = std::fs::read(path).map_err(|source| ProjectError::Io { path: path.into(), source })?;
    Ok(Mvs::read(&bytes).map_err(|fault| ProjectError::Fault { path: path.into(), fault })?)
}

/// For each view of the selection, the position of its image in the scene: the one whose path ends with the view's name.
fn positions(selection: &Selection, mvs: &Mvs, path: &Path) -> Result<Vec<usize>, BackendError> {
    let names: Vec<String> =
        mvs.images.iter().map(|image| String::from_utf8_lossy(&image.name).replace('\\', "/")).collect();
    let mut positions = vec![usize::MAX; selection.scene.views.len()];
    for view in selection.views() {
        let name = selection.scene.name(view);
        let is = |image: &str| image == name || image.strip_suffix(name).is_some_and(|rest| rest.ends_with('/'));
        let found: Vec<usize> = (0..names.len()).filter(|&i| is(&names[i]) && mvs.images[i].pose != NO_POSE).collect();
        let [position] = found[..] else {
            return Err(BackendError::Needs {
                backend: "openmvs",
                what: format!("one calibrated image {name} in {}, which has {}", path.display(), found.len()),
                hint: "give a scene of the same images, or leave --scene out".into(),
            });
        };
        positions[view.at()] = position;
    }
    Ok(positions)
}

/// Depths of the sparse points of a key view, in units of the scene.
struct Depths {
    view: String,
    least: f64,
    median: f64,
    greatest: f64,
}

impl Depths {
    /// Of the scene's own vertices; of our points where it has none that the image sees.
    fn of(mvs: &Mvs, position: usize, selection: &Selection, view: ViewIndex) -> Self {
        let image = &mvs.images[position];
        let platform = &mvs.platforms[image.platform as usize];
        let (camera, pose) = (&platform.cameras[image.camera as usize], &platform.poses[image.pose as usize]);
        let pose_r = Matrix3::from_row_slice(&pose.r);
        let r = Matrix3::from_row_slice(&camera.r) * pose_r;
        let centre = pose_r.transpose() * Vector3::from(camera.c) + Vector3::from(pose.c);
        let depth = |x: [f32; 3]| (r * (Vector3::from(x.map(f64::from)) - centre)).z;
        let seen = mvs.vertices.iter().filter(|v| v.views.iter().any(|s| s.image as usize == position));
        let mut depths: Vec<f64> = seen.map(|v| depth(v.x)).filter(|z| *z > 0.0).collect();
        if depths.is_empty() {
            depths = crate::backends::selection::depths(selection.scene, &selection.scene.view_points(), view);
        }
        depths.sort_unstable_by(f64::total_cmp);
        let at = |share: f64| {
            let last = depths.len().checked_sub(1)?;
            depths.get((last as f64 * share).round() as usize).copied()
        };
        let [least, median, greatest] = [0.01, 0.5, 0.99].map(|share| at(share).unwrap_or(f64::NAN));
        Self { view: selection.scene.name(view).into(), least, median, greatest }
    }
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(SCALED_DEPTH)
}

fn check_depths(depths: &[Depths], scale: f64, scaled: bool) -> Result<(), BackendError> {
    let fits = |d: &&Depths| d.least * scale >= SEARCHED[0] && d.greatest * scale <= SEARCHED[1];
    let Some(wrong) = depths.iter().find(|d| !fits(d)) else { return Ok(()) };
    let hint = if scaled {
        "leave --scene out: a scene per cluster takes its range from the sparse points"
    } else {
        "add --scale, or leave --scene out"
    };
    Err(BackendError::Needs {
        backend: "openmvs",
        what: format!(
            "depths of {} to {} units with a list of neighbours, and those of {} are {:.3} to {:.3}",
            SEARCHED[0],
            SEARCHED[1],
            wrong.view,
            wrong.least * scale,
            wrong.greatest * scale
        ),
        hint: hint.into(),
    })
}

/// The scene at another size, without points.
fn scaled(mut mvs: Mvs, scale: f64) -> Mvs {
    let grow = |values: &mut [f64]| values.iter_mut().for_each(|v| *v *= scale);
    for platform in &mut mvs.platforms {
        platform.cameras.iter_mut().for_each(|camera| grow(&mut camera.c));
        platform.poses.iter_mut().for_each(|pose| grow(&mut pose.c));
    }
    // Without region of interest the corners are the greatest numbers there are, in the wrong order.
    if (0..3).all(|i| mvs.region[9 + i] < mvs.region[12 + i]) {
        grow(&mut mvs.region[9..]);
    }
    for image in &mut mvs.images {
        image.depths = image.depths.map(|depth| (f64::from(depth) * scale) as f32);
        image.view_scores.clear();
    }
    mvs.without_points()
}
