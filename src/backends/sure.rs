//! SURE (nFrames), not run: closed. The files follow the vendor's public pages and three public
//! writers of `.ori`, one of which calls SURE 1.2.
//!
//! No public file names pairs, so exact partners need one project per cluster, and SURE may still
//! reject some by angle or overlap. In `.ori`, x = K [R | -R C] X: R is COLMAP's, the "translation
//! vector" is the camera centre, and the centre of the first pixel is (0, 0). Focal length and
//! pixel size are not used. Black pixels are invalid.

use super::{
    Backend, BackendError, Capabilities, ExaminedProject, Export, ExportOptions, ExportRecord,
    Honours, LastRun, PlanningNumbers, Selection, Trap,
    clusters::{ClusterScript, recipe},
    semi_global::{CONFIDENCE, PHOTOMETRIC, checked_name, lists_of_pairs},
    strangers::name_links_in_scripts,
};
use std::collections::HashMap;

use crate::{
    base::paths::stem,
    io::{formats::sure, output::FileSet, project::ProjectKind},
    model::{
        cluster::{Gate, MapScale, RankedCluster},
        scene::ViewIndex,
    },
};

/// Numbers of a matcher of rectified pairs (method 7.1 and 7.2).
const RECTIFYING: PlanningNumbers = PlanningNumbers {
    reach: None,
    // Scale ratio 1.7.
    gate: Gate {
        min_shared_points: 1,
        min_angle_deg: 1.0,
        max_angle_deg: 60.0,
        max_scale_octaves: 0.7655,
        epipole_inside: false,
    },
    confidence: CONFIDENCE,
    photometric: PHOTOMETRIC,
    support: 1,
    work: super::openmvs::WORK,
    measured: "valley (sgm)",
    caution: Some("SURE itself was not run: a stand-in gave 29 and 61 % of what was foreseen."),
    source: "gate: of rectified pairs, measured on valley against exact depth (method 7.1); confidence: integrations/sgm's, by whose \
             real curves it ranks best (method 7.2's 0.8, a cosine and 0.7 octaves rank worse than none); SURE itself was not \
             run; support 1: a depth map is checked against its own pairs",
};

pub static BACKEND: Backend = Backend {
    name: "sure",
    aliases: &["nframes"],
    program: "SURE",
    last_run: LastRun::Never("documentation, and programs that write its files"),
    capabilities: Capabilities {
        partners: Honours::Partly,
        key_subset: Honours::Yes,
        order: Honours::Partly,
        fusion: "built in; each depth map is checked against its own pairs",
        notes: "no public file names pairs: exact partners need one project per cluster",
    },
    planning: RECTIFYING,
    mixes_sizes: true,
    serves: |project| project.kind == ProjectKind::Sure,
    traps,
    export,
    ..Backend::DEFAULT
};

fn traps(examined: &ExaminedProject) -> Vec<Trap> {
    let same = examined.same_names(
        "sure-same-stem",
        "the same image to SURE, which ignores folders and extensions",
        |name| stem(&name.replace('/', "_")).to_lowercase(),
    );
    let bad = examined.bad_names("sure-name", |name| checked_name("sure", name).map(|_| ()));
    same.into_iter().chain(bad).collect()
}

fn export(selection: &Selection, options: &ExportOptions) -> Result<Export, BackendError> {
    let images = selection.undistorted_images(BACKEND.name)?;
    let names = flat_names(selection)?;
    let mut files = options.file_set(&BACKEND, selection);
    for view in selection.views() {
        let name = &names[view.index()];
        files.add(
            format!("images/{name}"),
            images.link(selection.scene.name(view)),
        );
        files.add_text(
            format!("ori/{}.ori", stem(name)),
            orientation(selection, view, name),
        );
    }
    let [clusters, pairs, _] = lists_of_pairs(selection, |v| Ok(names[v.index()].as_str()))?;
    for (name, text) in [clusters, pairs] {
        files.add_text(name, text);
    }
    add_lists(
        &mut files,
        "",
        &names,
        &selection.views(),
        &selection.clusters.iter().map(|c| c.key).collect::<Vec<_>>(),
    );
    for cluster in selection.clusters {
        add_lists(
            &mut files,
            &format!("clusters/{}/", project(selection, cluster)),
            &names,
            &Vec::from_iter(cluster.views()),
            &[cluster.key],
        );
    }
    let record = record_of(selection, &names);
    files.add_script("run.sh", shell_script(selection));
    name_links_in_scripts(&mut files);
    files.add_text("run.bat", batch_script(selection));
    Ok(Export::new(files, record))
}

fn record_of(selection: &Selection, names: &[String]) -> ExportRecord {
    let mut record = ExportRecord::new(&BACKEND, selection, |v| names[v.index()].clone());
    record.runner = Some("run.sh".into());
    record.made_for =
        "SURE (from the vendor's public pages and public scripts for SURE 1.2; not run)".into();
    record.way = "one project per cluster; lists for a joint project beside".into();
    for cluster in selection.clusters {
        let folder = format!("projects/{}", project(selection, cluster));
        let [prepare, compute] = calls(selection, cluster, &folder, "sure");
        record
            .commands
            .extend([format!("mkdir -p {folder} && {prepare}"), compute]);
    }
    record.not_honoured.extend([
        "partners in a joint project (images.txt, ori.txt, baseImages.txt): no public file names pairs".into(),
        "partners that SURE itself rejects by angle or overlap".into(),
    ]);
    if selection
        .clusters
        .iter()
        .any(|cluster| cluster.scale == MapScale::Half)
    {
        record
            .not_honoured
            .push("sizes in a joint project: -pyr is one for all its images".into());
    }
    record.warnings.extend([
        "whether the releases of today keep -select and -maxmodels is not publicly documented".into(),
        "pixels that are exactly black count as invalid".into(),
        "lists name files from their own folder on; where a release reads them from elsewhere, make them absolute"
            .into(),
    ]);
    record.note_scale(selection, |_| selection.halved());
    record.pixel_shift = -0.5;
    record.fusion =
        "each project gives points of its key view; one DSM or mesh run joins them".into();
    record
}

/// Name of the project of a cluster: the id of the image, which is the same in each plan.
fn project(selection: &Selection, cluster: &RankedCluster) -> String {
    format!("{:08}", selection.scene.view(cluster.key).image_id)
}

/// Returns the two calls of the program for a cluster, whose project is in this folder already.
fn calls(
    selection: &Selection,
    cluster: &RankedCluster,
    folder: &str,
    program: &str,
) -> [String; 2] {
    let lists = format!("clusters/{}", project(selection, cluster));
    let lists =
        format!("-img {lists}/images.txt -ori {lists}/ori.txt -select {lists}/baseImages.txt");
    let (partners, level) = (
        cluster.partners.len(),
        selection.pyramid_level(cluster.scale),
    );
    let fold = partners.clamp(1, 2);
    [
        format!(
            "{program} -basepath {folder} {lists} -fold {fold} -pyr {level} -maxmodels {partners} -prep"
        ),
        format!("{program} -basepath {folder}"),
    ]
}

/// Returns the name of a project in `run.sh`, with the hash of what it is made from.
fn result_name(selection: &Selection, cluster: &RankedCluster) -> String {
    let name = project(selection, cluster);
    // Of the calls too: with another level or number of partners it is another project.
    let recipe = recipe(
        selection,
        cluster,
        &calls(selection, cluster, &name, "sure").concat(),
    );
    format!("{name}-{recipe}")
}

/// Returns `run.sh`, with two calls per cluster.
fn shell_script(selection: &Selection) -> String {
    let names: Vec<String> = selection
        .clusters
        .iter()
        .map(|cluster| result_name(selection, cluster))
        .collect();
    let mut script =
        ClusterScript::new(&names, include_str!("../../integrations/sure/run_head.sh"));
    for (cluster, name) in selection.clusters.iter().zip(&names) {
        let folder = format!("projects/{name}");
        // SURE may note the paths of its projects, which therefore stay where they are made.
        let finished = format!("{folder}/viewrank.finished");
        let [prepare, compute] = calls(selection, cluster, &folder, "\"${SURE:-sure}\"");
        let commands = [
            format!("mkdir -p {folder}"),
            prepare,
            compute,
            format!("note finished {finished}"),
        ];
        script.cluster(name, &format!("[ -f {finished} ]"), &commands);
    }
    script.finish(&[])
}

/// Returns `run.bat`, which runs every cluster each time.
fn batch_script(selection: &Selection) -> String {
    let cluster = |cluster: &RankedCluster| {
        let name = project(selection, cluster);
        let folder = format!("projects/{name}");
        let calls = calls(selection, cluster, &folder, "sure.exe")
            .join(" && ")
            // cmd takes a slash for the start of an option.
            .replace('/', "\\");
        let folder = folder.replace('/', "\\");
        format!(
            "(if not exist {folder} mkdir {folder}) && {calls} || (echo error: {name} failed & set failed=1)\r\n"
        )
    };
    let clusters: String = selection.clusters.iter().map(cluster).collect();
    format!("@echo off\r\ncd /d \"%~dp0\"\r\nset failed=0\r\n{clusters}exit /b %failed%\r\n")
}

/// Returns names without folders. SURE ignores extensions, so stems must differ.
fn flat_names(selection: &Selection) -> Result<Vec<String>, BackendError> {
    let mut by_stem: HashMap<String, ViewIndex> = HashMap::new();
    let mut names = vec![String::new(); selection.scene.views.len()];
    for view in selection.views() {
        let name = selection.scene.name(view);
        let flat = checked_name("sure", name)?.replace('/', "_");
        // Windows takes names that differ in case alone for one file.
        if let Some(other) = by_stem.insert(stem(&flat).to_lowercase(), view) {
            let why = format!(
                "without folder and extension it is the same as {}",
                selection.scene.name(other)
            );
            return Err(BackendError::name("sure", name, why));
        }
        names[view.index()] = flat;
    }
    Ok(names)
}

fn orientation(selection: &Selection, view: ViewIndex, name: &str) -> String {
    let scene = selection.scene;
    let text = sure::write(
        name,
        scene.camera_of(view),
        &scene.view(view).cam_from_world,
    );
    text.expect("`undistorted_images` refuses cameras with distortion")
}

/// Adds the lists of images and orientations, which SURE associates by their order, and of base
/// images.
fn add_lists(
    files: &mut FileSet,
    folder: &str,
    names: &[String],
    views: &[ViewIndex],
    keys: &[ViewIndex],
) {
    let list = |line: &dyn Fn(&str) -> String| {
        views
            .iter()
            .map(|v| line(&names[v.index()]))
            .collect::<String>()
    };
    let up = "../".repeat(folder.matches('/').count());
    files.add_text(
        format!("{folder}images.txt"),
        list(&|name| format!("{up}images/{name}\n")),
    );
    files.add_text(
        format!("{folder}ori.txt"),
        list(&|name| format!("{up}ori/{}.ori\n", stem(name))),
    );
    let keys = keys
        .iter()
        .map(|k| format!("{}\n", stem(&names[k.index()])));
    files.add_text(format!("{folder}baseImages.txt"), keys.collect::<String>());
}
