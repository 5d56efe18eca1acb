//! PMVS2 (101c2ee, run): key views are `timages`, whose patches are kept, other partners `oimages`,
//! which are matched only, the partner lists `vis.dat`.
//!
//! Rows of `vis.dat` count by position; their first number is thrown away. Partner lists are
//! directed: for each patch PMVS2 takes the best of a row, at most twice `minImageNum`, which is 3
//! (2 with one partner). An image in both lists loses its partners, lists have no comments, unknown
//! options end the program, and `-1 a b` excludes b. Which pixel convention it assumes is not
//! known; matrices are as in COLMAP's own export.

use super::{
    Backend, BackendError, Capabilities, ExaminedProject, Export, ExportOptions, ExportRecord,
    Honours, LastRun, PATCH_MATCH, PlanningNumbers, Selection, Trap, selection,
    strangers::add_runner,
};
use crate::{
    io::{output::Contents, project::Project},
    model::{
        cluster::MapScale,
        scene::{PointIndex, Scene, ViewIndex},
    },
};

/// Name of the option file; `viewrank` itself is the folder of viewrank's records.
const OPTIONS: &str = "option-viewrank";

pub static BACKEND: Backend = Backend {
    name: "pmvs",
    aliases: &["pmvs2", "cmvs"],
    program: "PMVS2, CMVS",
    last_run: LastRun::At {
        date: "2026-11-24",
        version: "101c2ee",
        what: "pmvs2",
    },
    capabilities: Capabilities {
        partners: Honours::Partly,
        key_subset: Honours::Yes,
        order: Honours::No,
        fusion: "none needed: it makes patches, not depth maps",
        notes: "patches start in the key views and are matched in their partners and in other images of the plan that share points; the order of key views is PMVS2's own",
    },
    planning: PlanningNumbers {
        support: 1,
        source: "not measured: the numbers of OpenMVS and COLMAP, also a PatchMatch; support 1: patches are not checked against depth maps",
        ..PATCH_MATCH
    },
    traps,
    export,
    ..Backend::DEFAULT
};

fn traps(examined: &ExaminedProject) -> Vec<Trap> {
    examined
        .bad_names("pmvs-extension", |name| extension(examined.project, name))
        .into_iter()
        .collect()
}

fn export(selection: &Selection, options: &ExportOptions) -> Result<Export, BackendError> {
    let near = selection.near_origin();
    let selection = &near.selection();
    let images = selection.undistorted_images(BACKEND.name)?;
    let views = selection.keys_first();
    let mut index = vec![0; selection.scene.views.len()];
    views
        .iter()
        .enumerate()
        .for_each(|(i, v)| index[v.index()] = i);
    let mut files = options.file_set(&BACKEND, selection);
    for (i, &view) in views.iter().enumerate() {
        let name = selection.scene.name(view);
        let extension = extension(selection.project, name)?;
        files.add_text(
            format!("txt/{i:08}.txt"),
            format!("CONTOUR\n{}", projection(selection.scene, view)),
        );
        files.add(format!("visualize/{i:08}.{extension}"), images.link(name));
    }
    files.add("models", Contents::Folder);
    files.add_text("vis.dat", visibility(selection, &views, &index));
    files.add_text(OPTIONS, option_file(selection, views.len()));
    let mut record = ExportRecord::new(&BACKEND, selection, |v| index[v.index()].to_string());
    record.moved(near.origin);
    record.made_for = "PMVS2 (CMVS-PMVS)".into();
    record.way = "timages, oimages, vis.dat".into();
    // PMVS2 concatenates folder and file names: the slash is required.
    record.commands = vec![format!("pmvs2 ./ {OPTIONS}")];
    record.not_honoured.extend([
        "only the partners: PMVS2 chooses for each patch among all images of the export that share points with its key view".into(),
        "the rank order".into(),
    ]);
    record.note_scale(selection, |_| selection.halved());
    record.fusion = format!("none; models/{OPTIONS}.ply");
    add_runner(&mut files, &mut record);
    Ok(Export::new(files, record))
}

/// Returns P = K [R | t], row major, in COLMAP's pixel convention (as COLMAP's own export for
/// PMVS).
pub(super) fn projection(scene: &Scene, view: ViewIndex) -> String {
    let pose = &scene.view(view).cam_from_world;
    let (f, c) = scene.camera_of(view).pinhole_part();
    let k = nalgebra::Matrix3::new(f.x, 0.0, c.x, 0.0, f.y, c.y, 0.0, 0.0, 1.0);
    let (r, t) = (k * pose.rotation.matrix(), k * pose.translation);
    (0..3)
        .map(|i| format!("{} {} {} {}\n", r[(i, 0)], r[(i, 1)], r[(i, 2)], t[i]))
        .collect()
}

/// PMVS2 chooses the decoder by the extension.
fn extension(project: &Project, name: &str) -> Result<&'static str, BackendError> {
    let why = "it reads jpg, png, tiff and ppm, by the extension";
    let file = selection::name_of_kind(project, name);
    selection::extension(&file, &["jpg", "png", "tiff", "ppm"])
        .ok_or_else(|| BackendError::name("pmvs", name, why))
}

/// Returns `vis.dat`: rows are identified by position, one for each image, also for those without
/// partners.
///
/// Behind a key view's partners stand the other images of the export that observe a point with it.
/// PMVS2 holds them anyway, and chooses the best of the row for each patch: with the partners
/// alone, patches end where those of another key view should go on.
fn visibility(selection: &Selection, views: &[ViewIndex], index: &[usize]) -> String {
    let together = observed_together(selection, views, index);
    let mut text = format!("VISDATA\n{}\n", views.len());
    for i in 0..views.len() {
        let partners = selection.clusters.get(i).map_or(&[][..], |c| &c.partners);
        let mut row: Vec<usize> = partners.iter().map(|p| index[p.index()]).collect();
        if let Some(together) = together.get(i) {
            row.extend(
                (0..views.len())
                    .filter(|&other| together[other] && !partners.contains(&views[other])),
            );
        }
        text += &format!("{i} {}", row.len());
        row.iter().for_each(|other| text += &format!(" {other}"));
        text.push('\n');
    }
    text
}

/// For each key view, which of the exported images observe a point that it observes.
fn observed_together(
    selection: &Selection,
    views: &[ViewIndex],
    index: &[usize],
) -> Vec<Vec<bool>> {
    let keys = selection.clusters.len();
    let mut together = vec![vec![false; views.len()]; keys];
    for point in 0..selection.scene.points.len() {
        let track = selection.scene.track_views(PointIndex(point as u32));
        let exported: Vec<usize> = track
            .iter()
            .map(|v| (v, index[v.index()]))
            // A view outside the export has index 0 too, like the first one in it.
            .filter(|&(v, i)| views.get(i) == Some(v))
            .map(|(_, i)| i)
            .collect();
        for &key in exported.iter().filter(|&&i| i < keys) {
            exported
                .iter()
                .filter(|&&other| other != key)
                .for_each(|&other| together[key][other] = true);
        }
    }
    together
}

/// Returns the option file, without comments: one inside a list would end the program.
fn option_file(selection: &Selection, views: usize) -> String {
    let keys = selection.clusters.len();
    let list = |range: std::ops::Range<usize>| range.map(|i| format!(" {i}")).collect::<String>();
    let level = selection.pyramid_level(MapScale::Full);
    let seen_by = (selection.most_partners() + 1).clamp(2, 3);
    format!(
        "timages {keys}{}\noimages {}{}\nuseVisData 1\nlevel {level}\ncsize 2\nthreshold 0.7\nwsize 7\nminImageNum {seen_by}\nCPU 4\n",
        list(0..keys),
        views - keys,
        list(keys..views),
    )
}
