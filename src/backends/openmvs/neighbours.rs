//! The plain list of neighbours for an existing `scene.mvs`.
//!
//! It replaces only the neighbours of the listed images: OpenMVS computes the other images too, and
//! searches depths of 0.1 to 100 units for the listed ones, regardless of the scene. So the depths
//! are checked, and on request a copy of the scene is made at a scale that fits, without points, so
//! that only the listed images can be computed.

use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Vector3};

use super::{BACKEND, dense_config, resolution};
use crate::{
    backends::{
        BackendError, Export, ExportOptions, ExportRecord, Selection,
        record::capped_scale,
        selection::{self, origin_among},
    },
    base::{
        input::{self, FileKind},
        median::upper_median,
    },
    io::{
        formats::openmvs::{Mvs, NO_POSE},
        output::Contents,
        project::ProjectError,
    },
    model::{cluster::RankedCluster, scene::ViewIndex},
};

/// Depths that OpenMVS searches for an image with given neighbours, scene units.
const SEARCHED: [f64; 2] = [0.1, 100.0];
/// Tolerance when comparing distances between cameras of scene and model, share of the cameras'
/// spread.
const SAME_SHAPE: f64 = 0.01;
/// Median depth of the key views in a scaled scene, units.
const SCALED_DEPTH: f64 = 10.0;

pub fn export(
    selection: &Selection,
    options: &ExportOptions,
    path: &Path,
) -> Result<Export, BackendError> {
    let given = GivenScene::read(selection, path)?;
    let depths = given.depths();
    let scale = if options.scale {
        SCALED_DEPTH / upper_median(depths.iter().map(|d| d.median)).unwrap_or(SCALED_DEPTH)
    } else {
        1.0
    };
    check_depths(&depths, scale, options.scale)?;

    let mut record = ExportRecord::new(&BACKEND, selection, |v| given.name(v));
    record.made_for = "OpenMVS v2.0 to v2.3 and develop (run with v2.3.0)".into();
    record.pixel_shift = -0.5;
    record.scale = scale;
    let origin = given.origin();
    record.moved(origin);
    let lists = given.lists();
    // Moved before it is scaled: the origin in the record is in units of the given scene.
    let scene = moved(given.mvs, origin);
    let scene = if options.scale {
        scaled(scene, scale)
    } else {
        scene
    };
    let scene = with_absolute_paths(scene, &folder_of(path)).write();
    let size = resolution(selection);
    let densify = Densify::new(&scene, &lists, size);
    let mut files = options.file_set(&BACKEND, selection);
    files.add(&*densify.work, Contents::Folder);
    files.add("scene.mvs", Contents::Bytes(scene));
    files.add_text("neighbours.txt", lists);
    files.add_text("dense.cfg", dense_config(selection));
    if options.scale {
        let unscale = include_str!("../../../integrations/openmvs/unscale.py");
        files.add_script("unscale.py", unscale);
        record.way = "list of neighbours, with a scaled copy of the scene without points".into();
        record.commands = vec![
            densify.command(1),
            format!("python3 -I unscale.py dense.ply dense_unscaled.ply {scale}"),
        ];
        record.fusion = "number-views-fuse 1: partners have no depth maps that could agree".into();
    } else {
        record.way = "list of neighbours, with a copy of the existing scene".into();
        record.commands = vec![densify.command(2)];
        record.not_honoured.push(
            "only the key views: images that are not listed get depth maps too, with OpenMVS's own neighbours".into(),
        );
        record.fusion = "number-views-fuse 2".into();
    }
    record.not_honoured.push("the rank order".into());
    record.note_scale(selection, capped_scale(size));
    Ok(Export::new(files, record))
}

/// The run that matches the lists.
struct Densify {
    /// OpenMVS keeps every depth map in its working folder, even of other scenes: so each scene,
    /// with its lists and the size of its images, has a folder of its own.
    work: String,
    size: u32,
}

impl Densify {
    fn new(scene: &[u8], lists: &str, size: u32) -> Self {
        let mut made_from = blake3::Hasher::new();
        made_from
            .update(scene)
            .update(lists.as_bytes())
            .update(&size.to_le_bytes());
        let work = format!("maps-{}", &made_from.finalize().to_hex()[..8]);
        Self { work, size }
    }

    /// `fuse`: maps that must agree on a point.
    fn command(&self, fuse: usize) -> String {
        let Self { work, size } = self;
        format!(
            "DensifyPointCloud -w \"$PWD/{work}\" -i \"$PWD/scene.mvs\" -o \"$PWD/dense.mvs\" --view-neighbors-file \"$PWD/neighbours.txt\" \
             --dense-config-file \"$PWD/dense.cfg\" --resolution-level 0 --min-resolution 16 --max-resolution {size} --number-views 0 \
             --geometric-iters 0 --number-views-fuse {fuse}"
        )
    }
}

/// The existing scene, and where it has the views of the selection.
struct GivenScene<'a> {
    selection: &'a Selection<'a>,
    mvs: Mvs,
    /// Index of each view's image in the scene.
    positions: Vec<usize>,
    /// Centres of the cameras in the scene, in the order of [`Selection::views`].
    centres: Vec<Vector3<f64>>,
    /// Scene units per model unit.
    size: f64,
}

impl<'a> GivenScene<'a> {
    fn read(selection: &'a Selection<'a>, path: &Path) -> Result<Self, BackendError> {
        let mvs = read(path)?;
        let positions = positions(selection, &mvs, path)?;
        let views = selection.views();
        let image = |view: &ViewIndex| &mvs.images[positions[view.index()]];
        let centre = |view| mvs.rotation_and_centre(image(view)).1;
        let centres: Vec<Vector3<f64>> = views.iter().map(centre).collect();
        let size = size_of_scene(selection, &centres, path)?;
        Ok(Self {
            selection,
            mvs,
            positions,
            centres,
            size,
        })
    }

    /// The name of a view in the lists.
    fn name(&self, view: ViewIndex) -> String {
        self.positions[view.index()].to_string()
    }

    fn lists(&self) -> String {
        let line = |cluster: &RankedCluster| {
            let names: Vec<String> = cluster.views().map(|view| self.name(view)).collect();
            names.join(" ") + "\n"
        };
        self.selection.clusters.iter().map(line).collect()
    }

    fn origin(&self) -> Vector3<f64> {
        let gsd = self.selection.scene.median_gsd();
        origin_among(&self.centres, gsd.map(|gsd| gsd * self.size))
    }

    fn depths(&self) -> Vec<Depths> {
        let of_key = |c: &RankedCluster| Depths::new(self, c.key);
        self.selection.clusters.iter().map(of_key).collect()
    }
}

/// Paths in a scene are relative to its folder.
fn folder_of(scene: &Path) -> PathBuf {
    std::path::absolute(scene)
        .ok()
        .and_then(|scene| scene.parent().map(Path::to_path_buf))
        .unwrap_or_default()
}

fn read(path: &Path) -> Result<Mvs, BackendError> {
    let bytes = input::read(path, FileKind::Sparse).map_err(ProjectError::io(path))?;
    Ok(Mvs::read(&bytes).map_err(ProjectError::fault(path))?)
}

/// Returns, for each view of the selection, the index of its image in the scene: the one with the
/// shortest path that ends with the view's name, since a name may be the end of another.
fn positions(selection: &Selection, mvs: &Mvs, path: &Path) -> Result<Vec<usize>, BackendError> {
    let names: Vec<String> = mvs
        .images
        .iter()
        // A scene that was written on Windows has backslashes.
        .map(|image| String::from_utf8_lossy(&image.name).replace('\\', "/"))
        .collect();
    let mut positions = vec![usize::MAX; selection.scene.views.len()];
    for view in selection.views() {
        let name = selection.scene.name(view);
        let is = |image: &str| {
            image == name
                || image
                    .strip_suffix(name)
                    .is_some_and(|rest| rest.ends_with('/'))
        };
        let mut found: Vec<usize> = (0..names.len())
            .filter(|&i| is(&names[i]) && mvs.images[i].pose != NO_POSE)
            .collect();
        let shortest = found.iter().map(|&i| names[i].len()).min();
        found.retain(|&i| Some(names[i].len()) == shortest);
        let [position] = found[..] else {
            return Err(BackendError::Needs {
                backend: "openmvs",
                what: format!(
                    "one calibrated image {name} in {}, which has {}",
                    path.display(),
                    found.len()
                ),
                hint: "give a scene of the same images, or leave --scene out".into(),
            });
        };
        positions[view.index()] = position;
    }
    Ok(positions)
}

/// Returns scene units per model unit, from the spread of the cameras in both. `of_scene`: centres
/// of the selection's cameras in the scene.
///
/// # Errors
/// Fails if the cameras are arranged differently from the model's.
fn size_of_scene(
    selection: &Selection,
    of_scene: &[Vector3<f64>],
    path: &Path,
) -> Result<f64, BackendError> {
    let views = selection.views();
    if views.len() < 2 {
        return Ok(1.0);
    }
    let of_model: Vec<Vector3<f64>> = views
        .iter()
        .map(|&v| selection.scene.view(v).cam_from_world.centre().coords)
        .collect();
    let spread_of_scene = spread(of_scene);
    let size = spread_of_scene / spread(&of_model);
    let same = |i: usize, j: usize| {
        let [model, scene] =
            [&of_model[..], of_scene].map(|centres| (centres[i] - centres[j]).norm());
        (scene - size * model).abs() <= SAME_SHAPE * spread_of_scene
    };
    // Cameras that are all in one place have no spread, and give 0, infinity or NaN.
    if size.is_normal() && (1..views.len()).all(|i| same(i, i - 1)) {
        return Ok(size);
    }
    Err(BackendError::Needs {
        backend: "openmvs",
        what: format!(
            "the cameras of the model, and {} has them in other places",
            path.display()
        ),
        hint: "give a scene made from this model, or leave --scene out".into(),
    })
}

/// Moves the scene's origin to `origin`.
fn moved(mut mvs: Mvs, origin: Vector3<f64>) -> Mvs {
    for pose in mvs
        .platforms
        .iter_mut()
        .flat_map(|platform| &mut platform.poses)
    {
        pose.c = (Vector3::from(pose.c) - origin).into();
    }
    for vertex in &mut mvs.vertices {
        vertex.x = (Vector3::from(vertex.x.map(f64::from)) - origin)
            .map(|x| x as f32)
            .into();
    }
    if has_region(&mvs) {
        // The corners of the region are in its own axes, which the first nine numbers turn to.
        let turned = Matrix3::from_row_slice(&mvs.region[..9]) * origin;
        (0..6).for_each(|i| mvs.region[9 + i] -= turned[i % 3]);
    }
    mvs
}

/// Returns whether a region of interest is set; otherwise its corners are the largest floats, in
/// inverse order.
fn has_region(mvs: &Mvs) -> bool {
    (0..3).all(|i| mvs.region[9 + i] < mvs.region[12 + i])
}

/// Returns the root mean square distance from the centroid.
fn spread(centres: &[Vector3<f64>]) -> f64 {
    let middle = centres.iter().sum::<Vector3<f64>>() / centres.len() as f64;
    (centres
        .iter()
        .map(|c| (c - middle).norm_squared())
        .sum::<f64>()
        / centres.len() as f64)
        .sqrt()
}

/// Depths of the sparse points of a key view, scene units.
struct Depths {
    view: String,
    least: f64,
    median: f64,
    greatest: f64,
}

impl Depths {
    /// Uses the scene's own vertices, or our points scaled to the scene if the image sees no
    /// vertex.
    fn new(given: &GivenScene, view: ViewIndex) -> Self {
        let (scene, position) = (given.selection.scene, given.positions[view.index()]);
        let (r, centre) = given.mvs.rotation_and_centre(&given.mvs.images[position]);
        let depth = |x: [f32; 3]| (r * (Vector3::from(x.map(f64::from)) - centre)).z;
        let seen = given
            .mvs
            .vertices
            .iter()
            .filter(|v| v.views.iter().any(|s| s.image as usize == position));
        let mut depths: Vec<f64> = seen.map(|v| depth(v.x)).filter(|z| *z > 0.0).collect();
        if depths.is_empty() {
            depths = selection::depths(scene, &scene.view_points(), view);
            depths.iter_mut().for_each(|depth| *depth *= given.size);
        }
        depths.sort_unstable_by(f64::total_cmp);
        let at = |share: f64| {
            let last = depths.len().checked_sub(1)?;
            depths.get((last as f64 * share).round() as usize).copied()
        };
        let [least, median, greatest] =
            // Not the extremes, since one wrong point would refuse the scene.
            [0.01, 0.5, 0.99].map(|share| at(share).unwrap_or(f64::NAN));
        Self {
            view: scene.name(view).into(),
            least,
            median,
            greatest,
        }
    }
}

fn check_depths(depths: &[Depths], scale: f64, scaled: bool) -> Result<(), BackendError> {
    let fits = |d: &&Depths| d.least * scale >= SEARCHED[0] && d.greatest * scale <= SEARCHED[1];
    let Some(wrong) = depths.iter().find(|d| !fits(d)) else {
        return Ok(());
    };
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

/// Returns the scene with image paths that are valid in any working folder.
fn with_absolute_paths(mut mvs: Mvs, folder: &Path) -> Mvs {
    let absolute = |name: &mut Vec<u8>| {
        if !name.is_empty() {
            *name = folder
                .join(String::from_utf8_lossy(name).replace('\\', "/"))
                .to_string_lossy()
                .into_owned()
                .into();
        }
    };
    for image in &mut mvs.images {
        absolute(&mut image.name);
        absolute(&mut image.mask);
    }
    mvs
}

/// Returns the scaled scene, without points.
fn scaled(mut mvs: Mvs, scale: f64) -> Mvs {
    let grow = |values: &mut [f64]| values.iter_mut().for_each(|v| *v *= scale);
    for platform in &mut mvs.platforms {
        platform
            .cameras
            .iter_mut()
            .for_each(|camera| grow(&mut camera.c));
        platform.poses.iter_mut().for_each(|pose| grow(&mut pose.c));
    }
    if has_region(&mvs) {
        grow(&mut mvs.region[9..]);
    }
    for image in &mut mvs.images {
        image.depths = image.depths.map(|depth| (f64::from(depth) * scale) as f32);
        image.view_scores.clear();
    }
    mvs.without_points()
}
