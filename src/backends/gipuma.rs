//! Gipuma (f16dbfd, read; it needs CUDA). One call per key view; the first image is the key view,
//! the others its partners. `fusibile` joins all folders of `results/`.

use super::{
    Backend, BackendError, Capabilities, ExaminedProject, Export, ExportOptions, ExportRecord,
    Honours, LastRun, PATCH_MATCH, Selection, Trap,
    clusters::{ClusterScript, recipe},
    pmvs, selection,
    strangers::name_links_in_scripts,
};
use crate::{
    io::{output::FileSet, project::ImageFolder},
    model::{
        cluster::RankedCluster,
        scene::{ViewIndex, ViewPoints},
    },
};

pub static BACKEND: Backend = Backend {
    name: "gipuma",
    aliases: &["fusibile"],
    program: "Gipuma",
    last_run: LastRun::Never("read at f16dbfd"),
    capabilities: Capabilities {
        partners: Honours::Yes,
        key_subset: Honours::Yes,
        order: Honours::Yes,
        fusion: "another program, fusibile, over all result folders",
        notes: "one call per key view",
    },
    planning: PATCH_MATCH,
    traps,
    export,
    ..Backend::DEFAULT
};

fn traps(examined: &ExaminedProject) -> Vec<Trap> {
    examined
        .without_points(
            "gipuma-depth-range-mandatory",
            "its depth range is not known",
        )
        .into_iter()
        .collect()
}

fn export(selection: &Selection, options: &ExportOptions) -> Result<Export, BackendError> {
    let near = selection.near_origin();
    let selection = &near.selection();
    let images = selection.undistorted_images(BACKEND.name)?;
    let views = selection.keys_first();
    let mut files = options.file_set(&BACKEND, selection);
    let names = add_views(&mut files, selection, images, &views);
    let points = selection.scene.view_points();
    let mut record = ExportRecord::new(&BACKEND, selection, |v| names[v.index()].clone());
    record.moved(near.origin);
    record.runner = Some("run.sh".into());
    record.made_for = "Gipuma (f16dbfd) and fusibile".into();
    record.way = "one call per key view".into();
    let (mut results, mut calls) = (Vec::new(), Vec::new());
    for cluster in selection.clusters {
        let call = call(selection, cluster, &points, &names)?;
        let recipe = recipe(selection, cluster, &call);
        let image = names[cluster.key.index()].trim_end_matches(".jpg");
        // As fusibile wants it: 2, date, time, image.
        results.push(format!("2_{recipe}_{image}"));
        record
            .commands
            .push(format!("gipuma {call} -output_folder results/"));
        calls.push(call);
    }
    // The head lists all results, and moves those of other plans aside before the first call.
    let mut script = ClusterScript::new(&results, RUNNER_HEAD);
    for (result, call) in results.iter().zip(calls) {
        script.cluster(
            result,
            &format!("[ -d results/{result} ]"),
            &[format!("map {result} {call}")],
        );
    }
    record.note_scale(selection, |_| 1.0);
    record.fusion = format!(
        "{FUSIBILE}: its default of 2 other views leaves little of the maps of key views alone"
    );
    files.add_script("run.sh", script.finish(&[]));
    name_links_in_scripts(&mut files);
    Ok(Export::new(files, record))
}

/// Adds images, projections and the table of names. Returns the names in the files, by view.
fn add_views(
    files: &mut FileSet,
    selection: &Selection,
    images: &ImageFolder,
    views: &[ViewIndex],
) -> Vec<String> {
    let scene = selection.scene;
    let mut names = vec![String::new(); scene.views.len()];
    let mut table = String::new();
    for &view in views {
        // Result folders are named by the name less four characters: an extension of three letters.
        // The id of the image is the same in each plan, so that no result is taken for that of
        // another image.
        let name = format!("{:08}.jpg", scene.view(view).image_id);
        files.add_text(format!("p/{name}.P"), pmvs::projection(scene, view));
        files.add(format!("images/{name}"), images.link(scene.name(view)));
        table += &format!("{name}\t{}\n", scene.name(view));
        names[view.index()] = name;
    }
    files.add_text("view_names.txt", table);
    names
}

/// Joins the maps where two agree, as the plan assumes (support 2): `num_consistent` counts the
/// other one.
const FUSIBILE: &str =
    "fusibile -input_folder results/ -p_folder p/ -images_folder images/ --num_consistent=1";

const RUNNER_HEAD: &str = include_str!("../../integrations/gipuma/run_head.sh");

/// Images and options of a call. Folders end with a slash, since they are put in front of names as
/// they are. The depth range is given, since it would be guessed otherwise, and `-view_selection`
/// is not, since it chooses at random.
fn call(
    selection: &Selection,
    cluster: &RankedCluster,
    points: &ViewPoints,
    names: &[String],
) -> Result<String, BackendError> {
    let key = cluster.key;
    let range = selection::depth_range(BACKEND.name, selection.scene, points, key)?;
    let images: Vec<&str> = cluster.views().map(|v| &*names[v.index()]).collect();
    Ok(format!(
        "{} -images_folder images/ -p_folder p/ --depth_min={} --depth_max={}",
        images.join(" "),
        // The range is that of the sparse points, and the surface goes beyond them.
        0.9 * range[0],
        1.1 * range[1]
    ))
}
