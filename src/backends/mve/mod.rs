//! MVE's dmrecon (bf2279f, run). It reads no partner lists but selects by shared features,
//! greedily, so each cluster gets a bundle in which only its partners share features with the key
//! view. The views share one scene, in which `run.sh` installs one bundle after the other; [`run`]
//! makes a scene of links for each.
//!
//! With fewer partners than `local-neighbors` a map is empty, with exit code 0. Ids count from 0,
//! key views first; lists of views (`-l`) run in parallel and skip those that have a map, so each
//! call has one view (`-m`). `depth-L` maps hold the length of the ray. `scene2pset -F` takes the
//! maps of one level, so two sizes make two clouds, of which `fssrecon` makes one surface.

mod run;

use self::run::{RUN, Row, Run};
use super::{
    Backend, BackendError, Capabilities, ExaminedProject, Export, ExportOptions, ExportRecord,
    Honours, LastRun, PATCH_MATCH, PlanningNumbers, Selection, TaskProgram, TaskRunner, Tasks,
    Trap,
    clusters::{map_script, task_ids},
    selection,
    strangers::name_links_in_scripts,
};
use crate::{
    base::printable::to_json,
    io::{output::FileSet, project::Project},
    method::confidence::Photometric,
    model::{
        camera::Camera,
        cluster::{MapScale, RankedCluster},
        scene::{Scene, ViewIndex, ViewPoints},
    },
};

/// Partners that must agree on each patch. dmrecon's default of 4 is meant for 20 neighbours: of 5
/// partners, 4 rarely see the same place.
const LOCAL_NEIGHBOURS: usize = 2;

pub static BACKEND: Backend = Backend {
    name: "mve",
    aliases: &["dmrecon"],
    program: "MVE",
    last_run: LastRun::At {
        date: "2026-11-30",
        version: "bf2279f",
        what: "dmrecon, scene2pset, fssrecon",
    },
    capabilities: Capabilities {
        partners: Honours::Partly,
        key_subset: Honours::Yes,
        order: Honours::Yes,
        fusion: "scene2pset and fssrecon",
        notes: "only the partners can be chosen, but dmrecon may leave some of them out",
    },
    planning: PlanningNumbers {
        photometric: Photometric {
            agree: 0.52,
            differ: 0.12,
            full_agreement: 0.96,
        },
        support: 1,
        measured: "4 sets, in part",
        caution: None,
        source: "agreement: viewrank train on 101 maps of bf2279f of boruszyn, lewis and statue, of the rendered one only depths within 1 % of the \
                 exact scene; room took no part and is foreseen better too; support 1: scene2pset joins all depths, confirmed or not; \
                 gate: the numbers of OpenMVS (method 7.1)",
        ..PATCH_MATCH
    },
    own_scale,
    mixes_sizes: true,
    tasks: Some(Tasks {
        program: TaskProgram {
            name: "dmrecon",
            variable: "DMRECON",
        },
        runner: tasks,
    }),
    traps,
    export,
    ..Backend::DEFAULT
};

/// Smallest power of two that reduces the image to at most `--max-pixels`, 1.5 million by default.
fn own_scale(camera: &Camera) -> f64 {
    let ratio = f64::from(camera.width) * f64::from(camera.height) / 1_500_000.0;
    // Each level has a quarter of the pixels of the one before.
    (-ratio.log(4.0).ceil().max(0.0)).exp2()
}

fn tasks(selection: &Selection, export: &Export) -> TaskRunner {
    let root = &export.files.root;
    let map = |cluster: &RankedCluster| {
        let view = folder(selection.scene, cluster.key);
        let level = selection.pyramid_level(cluster.scale);
        Some(root.join(run::map_of(&view, level)))
    };
    let clouds = joining(selection).into_iter();
    TaskRunner {
        python: None,
        commands: run::commands,
        is_whole: run::is_whole,
        finish: run::finish,
        lists: &[RUN],
        own: "",
        clouds: clouds.map(|(_, cloud)| root.join(cloud)).collect(),
        sizes_share_a_file: false,
        maps: selection.clusters.iter().map(map).collect(),
    }
}

fn traps(examined: &ExaminedProject) -> Vec<Trap> {
    let names = examined.bad_names("mve-extension", |name| extension(examined.project, name));
    names.into_iter().collect()
}

fn export(selection: &Selection, options: &ExportOptions) -> Result<Export, BackendError> {
    let clusters = (1..).zip(selection.clusters);
    // Their ids are of the plan, not of a scene that was moved.
    let rows = clusters.map(|(rank, cluster)| row(selection, rank, cluster));
    let rows: Vec<Row> = rows.collect::<Result<_, _>>()?;
    let near = selection.near_origin();
    let selection = &near.selection();
    let mut files = options.file_set(&BACKEND, selection);
    let views = selection.keys_first();
    let ids = selection.scene.places_of(views.iter().copied());
    add_views(selection, &views, &mut files)?;
    let points = selection.scene.view_points();
    for (row, cluster) in rows.iter().zip(selection.clusters) {
        let text = bundle(selection.scene, &points, cluster, &ids, views.len());
        files.add_text(&*row.bundle, text);
    }
    let id = |v: ViewIndex| ids[v.index()].expect("every view of a cluster has an id");
    let mut record = ExportRecord::new(&BACKEND, selection, |v| id(v).to_string());
    record.moved(near.origin);
    record.runner = Some("run.sh".into());
    record.made_for = "MVE (bf2279f)".into();
    record.way = "one bundle per cluster in one scene".into();
    record.note_scale(selection, |_| selection.halved());
    record
        .not_honoured
        .push("that every partner is used: dmrecon chooses among them".into());
    files.add_script("run.sh", script(selection, &rows, &mut record));
    let views = views.iter().map(|&view| folder(selection.scene, view));
    let run = Run {
        views: views.collect(),
        maps: rows,
    };
    files.add_text(RUN, to_json(&run));
    name_links_in_scripts(&mut files);
    Ok(Export::new(files, record))
}

/// Adds the folders of the views.
fn add_views(
    selection: &Selection,
    views: &[ViewIndex],
    files: &mut FileSet,
) -> Result<(), BackendError> {
    let images = selection.undistorted_images(BACKEND.name)?;
    for (id, &view) in views.iter().enumerate() {
        let scene = selection.scene;
        let name = format!("{}/meta.ini", folder(scene, view));
        files.add_text(name, meta(scene, view, id));
        files.add(picture(selection, view)?, images.link(scene.name(view)));
    }
    Ok(())
}

/// Path of the picture of a view.
fn picture(selection: &Selection, view: ViewIndex) -> Result<String, BackendError> {
    let extension = extension(selection.project, selection.scene.name(view))?;
    let folder = folder(selection.scene, view);
    Ok(format!("{folder}/undistorted.{extension}"))
}

fn row(selection: &Selection, rank: usize, cluster: &RankedCluster) -> Result<Row, BackendError> {
    let partners = cluster.partners.len();
    let level = selection.pyramid_level(cluster.scale);
    let camera = selection.scene.camera_of(cluster.key);
    let [id, _] = task_ids(&BACKEND, selection, cluster);
    let pictures = cluster.views().map(|view| picture(selection, view));
    Ok(Row {
        rank,
        id,
        view: folder(selection.scene, cluster.key),
        pictures: pictures.collect::<Result<_, _>>()?,
        bundle: format!("bundles/{rank:04}.out"),
        scale: cluster.scale,
        level,
        options: vec![
            format!("-s{level}"),
            format!("--neighbors={partners}"),
            format!("--local-neighbors={}", partners.min(LOCAL_NEIGHBOURS)),
            // The id of a key view is its rank.
            format!("-m{}", rank - 1),
            "--progress=simple".into(),
        ],
        // MVE rounds up at each halving.
        size: [camera.width, camera.height].map(|side| side.div_ceil(1 << level.min(31))),
    })
}

/// Returns `run.sh`, and adds to the record what it does.
fn script(selection: &Selection, rows: &[Row], record: &mut ExportRecord) -> String {
    for row in rows {
        let (bundle, options) = (&row.bundle, row.options.join(" "));
        record.commands.push(format!("cp {bundle} synth_0.out"));
        record.commands.push(format!("dmrecon {options} ."));
    }
    let clouds = joining(selection);
    let names: Vec<&str> = clouds.iter().map(|(_, cloud)| *cloud).collect();
    record.fusion = format!(
        "depth-L maps hold the length of the ray, not z; scene2pset joins them with confidences and scales; fssrecon {} surface.ply makes the surface",
        names.join(" ")
    );
    let mut fusion = String::new();
    for (_, cloud) in CLOUDS.iter().filter(|(_, cloud)| !names.contains(cloud)) {
        // A cloud that an earlier plan has left would be taken for part of this one.
        fusion += &format!("tried rm -f {cloud}\n");
    }
    for (options, cloud) in &clouds {
        let options = options.join(" ");
        record
            .commands
            .push(format!("scene2pset {options} . {cloud}"));
        fusion += &format!("join {cloud} {options}\n");
    }
    let maps = rows.iter().zip(selection.clusters).map(|(row, cluster)| {
        let key = selection.scene.name(cluster.key);
        let words = format!("{} {}", row.bundle, row.options.join(" "));
        (key, &*row.id, row.map(), words)
    });
    let steps = include_str!("../../../integrations/mve/run_steps.sh");
    map_script(steps, maps, &fusion)
}

/// The clouds of each size: `scene2pset` takes maps of one size, `fssrecon` any number of point
/// sets, in which each point has its own scale.
const CLOUDS: [(MapScale, &str); 2] = [
    (MapScale::Full, "fused.ply"),
    (MapScale::Half, "fused_half.ply"),
];

/// Returns the options of scene2pset for the maps of each size that the plan has, and the cloud
/// that it makes.
fn joining(selection: &Selection) -> Vec<([String; 2], &'static str)> {
    let of_size = |(scale, cloud): (MapScale, &'static str)| {
        let clusters = (1..).zip(selection.clusters);
        let mut ranks = clusters
            .filter(|(_, c)| c.scale == scale)
            .map(|(rank, _)| rank)
            .peekable();
        ranks.peek()?;
        let level = selection.pyramid_level(scale);
        Some((run::joined(ranks, level), cloud))
    };
    CLOUDS.into_iter().filter_map(of_size).collect()
}

/// Folder of a view and its depth map, named by the id of the image, which is the same in each
/// plan. MVE's own id, in `meta.ini`, counts from 0, since MVE refuses large ones.
fn folder(scene: &Scene, view: ViewIndex) -> String {
    format!("views/view_{:08}.mve", scene.view(view).image_id)
}

/// MVE finds the decoder by the extension.
fn extension(project: &Project, name: &str) -> Result<&'static str, BackendError> {
    let why = "it reads undistorted images as jpg and png, by the extension";
    let file = selection::name_of_kind(project, name);
    selection::extension(&file, &["jpg", "png"]).ok_or_else(|| BackendError::name("mve", name, why))
}

/// Returns `meta.ini`: focal length in units of the larger side, principal point in units of each
/// side.
fn meta(scene: &Scene, view: ViewIndex, id: usize) -> String {
    let (camera, pose) = (scene.camera_of(view), &scene.view(view).cam_from_world);
    let (f, c) = camera.pinhole_part();
    let (width, height) = (f64::from(camera.width), f64::from(camera.height));
    // A matrix is stored by columns, and MVE reads rotations by rows.
    let r = pose.rotation.matrix().transpose();
    let numbers = |values: &[f64]| {
        values
            .iter()
            .map(f64::to_string)
            .collect::<Vec<_>>()
            .join(" ")
    };
    format!(
        "[camera]\nfocal_length = {}\npixel_aspect = {}\nprincipal_point = {} {}\nradial_distortion = 0 0\nrotation = {}\ntranslation = {}\n\n\
         [view]\nid = {id}\nname = {}\n",
        focal_length(f.x, f.y, width, height),
        f.y / f.x,
        c.x / width,
        c.y / height,
        numbers(r.as_slice()),
        numbers(pose.translation.as_slice()),
        scene.name(view).replace(['\n', '\r'], " "),
    )
}

/// Returns the focal length in units of the larger side, measured after applying the pixels' aspect
/// ratio.
fn focal_length(fx: f64, fy: f64, width: f64, height: f64) -> f64 {
    if width * fy / fx < height {
        fy / height
    } else {
        fx / width
    }
}

/// Returns `synth_0.out` with the points that the key view shares with a partner; other cameras are
/// zero.
fn bundle(
    scene: &Scene,
    points: &ViewPoints,
    cluster: &RankedCluster,
    ids: &[Option<usize>],
    views: usize,
) -> String {
    let members: Vec<ViewIndex> = cluster.views().collect();
    let mut cameras = vec!["0 0 0\n".repeat(5); views];
    for &view in &members {
        if let Some(id) = ids[view.index()] {
            cameras[id] = bundle_camera(scene, view);
        }
    }
    let observers = |p| selection::observers(scene, p, |view| members.contains(&view));
    let shared: Vec<_> = points
        .observed_by(cluster.key)
        .iter()
        .map(|&p| (p, observers(p)))
        .filter(|(_, views)| views.len() > 1)
        .collect();
    let mut text = format!("drews 1.0\n{views} {}\n{}", shared.len(), cameras.concat());
    for (i, (p, observers)) in shared.iter().enumerate() {
        let (x, [r, g, b]) = (scene.points[p.index()], scene.colours[p.index()]);
        text += &format!("{} {} {}\n{r} {g} {b}\n{}", x.x, x.y, x.z, observers.len());
        observers
            .iter()
            .filter_map(|v| ids[v.index()])
            .for_each(|id| text += &format!(" {id} {i} 0"));
        text.push('\n');
    }
    text
}

fn bundle_camera(scene: &Scene, view: ViewIndex) -> String {
    let (camera, pose) = (scene.camera_of(view), &scene.view(view).cam_from_world);
    let (f, _) = camera.pinhole_part();
    let length = focal_length(f.x, f.y, f64::from(camera.width), f64::from(camera.height));
    let row = |i: usize| {
        let r = pose.rotation.matrix().row(i);
        format!("{} {} {}\n", r[0], r[1], r[2])
    };
    let t = pose.translation;
    format!(
        "{length} 0 0\n{}{}{}{} {} {}\n",
        row(0),
        row(1),
        row(2),
        t.x,
        t.y,
        t.z
    )
}
