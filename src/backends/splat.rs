//! Gaussian splatting and NeRF (read; models loaded by pycolmap 4.2 and COLMAP 3.8, no training).
//! They know no partners, only which images train: a reduced COLMAP model with nothing else beside
//! it, and the lists of those programs that read lists.
//!
//! gaussian-splatting takes all images of `sparse/0`, PINHOLE only, and cuts names at folders and
//! the first dot; gsplat holds out every `--test_every`-th image by name; brush takes the largest
//! model in the folder; nerfstudio requires all of its lists.
//!
//! Images kept for tests are listed for nerfstudio, whose model must have them. The others hold out
//! every n-th image, if any: gaussian-splatting with `--eval` (its `test.txt` is read with
//! `llffhold` 0 only, for which it has no option), brush and LichtFeld likewise. For them `train/`
//! is a workspace without the test images.

use std::collections::HashMap;

use nalgebra::{Matrix3, Matrix4, Vector3};
use serde_json::json;

use super::{
    Backend, BackendError, CUT_PANORAMAS, Capabilities, ExaminedProject, Export, ExportOptions,
    ExportRecord, Honours, LastRun, Selection, Trap,
    images::{ANY_PROGRAM, listed_views, name_lines},
    selection,
    workspace::{Workspace, add_workspace},
};
use crate::{
    base::{printable::to_json, shell::command_path},
    io::output::{Contents, FileSet},
    model::scene::{PointIndex, ViewIndex},
};

/// Where no images are kept for tests, every such image is also in the test lists.
const JUDGED: usize = 8;

pub static BACKEND: Backend = Backend {
    name: "splat",
    aliases: &[
        "3dgs",
        "gaussiansplatting",
        "splatting",
        "splats",
        "gsplat",
        "brush",
        "nerf",
        "nerfstudio",
    ],
    program: "Gaussian splats",
    last_run: LastRun::Never("no training; its models are loaded by COLMAP 3.8 and 4.2.1"),
    capabilities: Capabilities {
        partners: Honours::No,
        key_subset: Honours::Yes,
        order: Honours::No,
        fusion: "none: the images train one model",
        notes: "key views train; --refs keys+partners adds their partners",
    },
    planning: ANY_PROGRAM,
    options: &["--refs"],
    use_of_views: Some("Train on"),
    takes_distorted: true,
    traps,
    export,
    ..Backend::DEFAULT
};

fn traps(examined: &ExaminedProject) -> Vec<Trap> {
    let same =
        "the same image to gaussian-splatting, which cuts folders and what follows the first dot";
    examined
        .same_names("splat-duplicate-names", same, |name| {
            short_name(name).to_owned()
        })
        .into_iter()
        .collect()
}

fn export(selection: &Selection, options: &ExportOptions) -> Result<Export, BackendError> {
    let near = selection.near_origin();
    let views = listed_views(selection, options.refs);
    let tests = selection.kept_for_tests();
    let mut files = options.file_set(&BACKEND, selection);
    // Made of the model's own files, which are moved as they are written; all that follows takes
    // the scene that is moved already.
    add_models(&mut files, selection, near.origin, &views, &tests)?;
    let selection = &near.selection();
    let seeds = seeds(selection, &views);
    if !tests.is_empty() {
        let seeds = Contents::Bytes(seeds.clone());
        files.add("train/sparse/0/points3D.ply", seeds);
        files.add_text("sparse/0/test.txt", name_lines(selection, &tests));
    }
    files.add("sparse/0/points3D.ply", Contents::Bytes(seeds));
    add_lists(&mut files, selection, &views, &tests);
    let mut record = ExportRecord::new(&BACKEND, selection, |v| {
        format!("images/{}", selection.scene.name(v))
    });
    record.moved(near.origin);
    record.made_for = "gaussian-splatting, gsplat, brush, nerfstudio".into();
    record.way = format!("reduced model of {} images", views.len());
    if !tests.is_empty() {
        record.way += &format!(", and {} for tests", tests.len());
    }
    record.commands = commands(selection, &views, !tests.is_empty());
    record.not_honoured = not_honoured(!tests.is_empty());
    record.note_own_scale(selection);
    record.fusion = "none".into();
    record.warnings.extend(warnings(selection, &views));
    Ok(Export::new(files, record))
}

/// Adds the model of all images with them and, if some are kept for tests, that of the others.
fn add_models(
    files: &mut FileSet,
    selection: &Selection,
    origin: Vector3<f64>,
    views: &[ViewIndex],
    tests: &[ViewIndex],
) -> Result<(), BackendError> {
    let images = selection.images(BACKEND.name)?;
    let mut add = |tests, model, folder| {
        let images = Some((folder, images));
        let workspace = Workspace {
            views,
            tests,
            least_views: 2,
            model,
            images,
        };
        add_workspace(BACKEND.name, files, selection, workspace, origin)
    };
    add(tests, "sparse/0", "images")?;
    if !tests.is_empty() {
        add(&[], "train/sparse/0", "train/images")?;
    }
    Ok(())
}

fn not_honoured(has_tests: bool) -> Vec<String> {
    let tests = if has_tests {
        "test images, except by nerfstudio: other trainers hold out every n-th image, so train/ has no test images"
    } else {
        "tests: test_list.txt repeats training images, since nerfstudio must have one (plan with --test-every N)"
    };
    ["matching partners", "the rank order", tests]
        .into_iter()
        .map(String::from)
        .collect()
}

/// Commands, one for each program; gaussian-splatting only if it supports the images. Only
/// nerfstudio leaves the test images of the folder itself out.
fn commands(selection: &Selection, views: &[ViewIndex], has_tests: bool) -> Vec<String> {
    let folder = if has_tests { "train" } else { "." };
    let pinhole = views
        .iter()
        .all(|&v| selection.scene.camera_of(v).is_pinhole());
    let gsplat = format!(
        // With another factor, gsplat takes reduced images from `images_N`, by position.
        "python \"${{GSPLAT:?folder of gsplat}}\"/examples/simple_trainer.py default --data_dir {folder} --data_factor 1 --test_every {}",
        // gsplat holds out every n-th image from the first on. With more than there are, it is the
        // first alone.
        views.len() + 1
    );
    let original = format!(
        "python \"${{GAUSSIAN_SPLATTING:?folder of gaussian-splatting}}\"/train.py -s {folder}"
    );
    let nerfstudio = "ns-train splatfacto --data . colmap --colmap-path sparse/0 --images-path images --downscale-factor 1";
    [gsplat]
        .into_iter()
        .chain(pinhole.then_some(original))
        .chain([format!("brush {folder}"), nerfstudio.into()])
        .collect()
}

/// Adds nerfstudio's lists. It requires all splits if one exists; it checks for
/// `validation_list.txt` but opens `val_list.txt`.
fn add_lists(files: &mut FileSet, selection: &Selection, views: &[ViewIndex], tests: &[ViewIndex]) {
    let judged: Vec<ViewIndex> = match tests {
        [] => views.iter().copied().step_by(JUDGED).collect(),
        tests => tests.to_vec(),
    };
    let all = [views, tests].concat();
    files.add_text("train_list.txt", name_lines(selection, views));
    for list in ["test_list.txt", "val_list.txt", "validation_list.txt"] {
        files.add_text(list, name_lines(selection, &judged));
    }
    if all
        .iter()
        .all(|&v| selection.scene.camera_of(v).is_pinhole())
    {
        files.add_text(
            "transforms.json",
            to_json(&transforms(selection, &all, views, &judged)),
        );
    }
}

/// Returns nerfstudio's `transforms.json`: camera to world, with y up and z backward in the camera.
fn transforms(
    selection: &Selection,
    all: &[ViewIndex],
    views: &[ViewIndex],
    judged: &[ViewIndex],
) -> serde_json::Value {
    let path = |&v: &ViewIndex| format!("images/{}", selection.scene.name(v));
    let frame = |v: &ViewIndex| {
        let view = selection.scene.view(*v);
        let camera = selection.scene.camera_of(*v);
        let (f, c) = camera.pinhole_part();
        json!({
            "file_path": path(v),
            "w": camera.width, "h": camera.height,
            "fl_x": f.x, "fl_y": f.y, "cx": c.x, "cy": c.y,
            "transform_matrix": world_from_nerf_camera(&view.cam_from_world),
        })
    };
    let paths = |list: &[ViewIndex]| list.iter().map(path).collect::<Vec<_>>();
    json!({
        "camera_model": "OPENCV",
        "ply_file_path": "sparse/0/points3D.ply",
        "frames": all.iter().map(frame).collect::<Vec<_>>(),
        "train_filenames": paths(views),
        "val_filenames": paths(judged),
        "test_filenames": paths(judged),
    })
}

fn world_from_nerf_camera(pose: &crate::model::scene::Pose) -> [[f64; 4]; 4] {
    let rotation =
        pose.rotation.matrix().transpose() * Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, -1.0));
    let mut matrix = Matrix4::identity();
    matrix.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
    matrix
        .fixed_view_mut::<3, 1>(0, 3)
        .copy_from(&pose.centre().coords);
    std::array::from_fn(|i| std::array::from_fn(|j| matrix[(i, j)]))
}

/// Returns the points that at least two of the views observe, as PLY. Gaussian-splatting writes
/// this file once and never updates it, so we do.
fn seeds(selection: &Selection, views: &[ViewIndex]) -> Vec<u8> {
    let scene = selection.scene;
    let mut chosen = vec![false; scene.views.len()];
    views.iter().for_each(|v| chosen[v.index()] = true);
    let seen =
        |p: &PointIndex| selection::observers(scene, *p, |view| chosen[view.index()]).len() >= 2;
    let points: Vec<PointIndex> = (0..scene.points.len() as u32)
        .map(PointIndex)
        .filter(seen)
        .collect();
    let mut ply = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\n",
        points.len()
    );
    ["x", "y", "z", "nx", "ny", "nz"]
        .iter()
        .for_each(|name| ply += &format!("property float {name}\n"));
    ["red", "green", "blue"]
        .iter()
        .for_each(|name| ply += &format!("property uchar {name}\n"));
    let mut bytes = (ply + "end_header\n").into_bytes();
    for p in points {
        let x = scene.points[p.index()];
        // gaussian-splatting takes a file without normals for no points at all.
        [x.x, x.y, x.z, 0.0, 0.0, 0.0]
            .iter()
            .for_each(|v| bytes.extend((*v as f32).to_le_bytes()));
        bytes.extend(scene.colours[p.index()]);
    }
    bytes
}

/// Returns the name of an image in gaussian-splatting.
fn short_name(name: &str) -> &str {
    let file = name.rsplit('/').next().unwrap_or(name);
    file.split('.').next().unwrap_or(file)
}

fn warnings(selection: &Selection, views: &[ViewIndex]) -> Vec<String> {
    let mut warnings = Vec::new();
    if selection::has_panoramas(selection.scene) {
        warnings.push(format!("these programs take no panoramas: {CUT_PANORAMAS}"));
    } else if views
        .iter()
        .any(|&v| !selection.scene.camera_of(v).is_pinhole())
    {
        warnings.push(format!(
            "the cameras are distorted: gsplat and brush take that, gaussian-splatting stops, and transforms.json is left out; \
             `viewrank undistort {}` makes undistorted images, as does `colmap image_undistorter`",
            command_path(&selection.project.root)
        ));
    }
    if let Some(&first) = views.iter().min().filter(|_| views.len() > 1) {
        warnings.push(format!(
            "gsplat always holds the first image by name ({}) out: of these {} it trains on the others; the other trainers take all",
            selection.scene.name(first),
            views.len()
        ));
    }
    let mut by_stem: HashMap<&str, &str> = HashMap::new();
    for &view in views {
        let name = selection.scene.name(view);
        if let Some(other) = by_stem.insert(short_name(name), name) {
            warnings.push(format!("gaussian-splatting takes {other} and {name} for the same image: it cuts folders and what follows the first dot"));
        }
    }
    warnings
}
