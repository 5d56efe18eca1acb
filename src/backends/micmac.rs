//! MicMac (f8fe432, read, not run). `pairs.xml` is a pair file for C3DC, PIMs and MMByP, undirected
//! and without order; `ImSec/` names the secondary images of each master for Malt GeomImage, one
//! call per key view. Orientations stay those of the user's own `Ori-` folder.
//!
//! With `Master=AUTO` Malt takes its pattern of images for the master's name and puts it into a
//! shell command without quotes. C3DC and PIMs overwrite `ImSec` unless `ExpImSec=false`; a missing
//! one is silent. `MMLastNuage.xml` is there before the map is matched, so a map counts once
//! `viewrank.recipe` is beside it.

use std::collections::BTreeMap;

use super::{
    Backend, BackendError, Capabilities, ExaminedProject, Export, ExportOptions, ExportRecord,
    Honours, LastRun, PATCH_MATCH, Selection, Trap,
    clusters::{ClusterScript, recipe},
    strangers::name_links_in_scripts,
};
use crate::{
    base::{paths::stem, shell::quoted},
    io::depthmaps::MICMAC_MARK,
    model::cluster::RankedCluster,
};

pub static BACKEND: Backend = Backend {
    name: "micmac",
    aliases: &["mm3d"],
    program: "MicMac",
    last_run: LastRun::Never("read at f8fe432"),
    capabilities: Capabilities {
        partners: Honours::Yes,
        key_subset: Honours::Yes,
        order: Honours::Yes,
        fusion: "MicMac's own tools (MergeCloud)",
        notes: "Malt GeomImage, one call per key view; with the pair file (C3DC, PIMs) pairs are undirected and the order is lost",
    },
    planning: PATCH_MATCH,
    takes_distorted: true,
    traps,
    export,
    ..Backend::DEFAULT
};

fn traps(examined: &ExaminedProject) -> Vec<Trap> {
    let same = "the same folder to MicMac, which names it without the extension";
    let same = examined.same_names("micmac-same-stem", same, |name| stem(name).to_owned());
    examined
        .bad_names("micmac-name", check_name)
        .into_iter()
        .chain(same)
        .collect()
}

fn export(selection: &Selection, options: &ExportOptions) -> Result<Export, BackendError> {
    for view in selection.views() {
        check_name(selection.scene.name(view))?;
    }
    check_stems(selection)?;
    let images = selection.images(BACKEND.name)?;
    let mut files = options.file_set(&BACKEND, selection);
    for view in selection.views() {
        let name = selection.scene.name(view);
        files.add(name, images.link(name));
    }
    files.add_text("pairs.xml", pair_file(selection));
    for cluster in selection.clusters {
        let name = selection.scene.name(cluster.key);
        files.add_text(
            format!("ImSec/ImSec-{name}.xml"),
            secondary_images(selection, cluster),
        );
    }
    files.add_text("ImSec/FileImSel.xml", masters(selection));
    let mut record = ExportRecord::new(&BACKEND, selection, |v| selection.scene.name(v).into());
    record.made_for = "MicMac (f8fe432; read, not run)".into();
    record.way = "ImSec files, one Malt call per master; pair file beside".into();
    record.commands = vec!["./run.sh \"${ORI:?the Ori- folder of the MicMac project}\"".into()];
    record.warnings.extend([
        "orientations are not written: run.sh takes the Ori- folder of the MicMac project that the model comes from"
            .into(),
    ]);
    record.note_scale(selection, |_| 1.0);
    record.fusion = "MicMac's MergeCloud, by hand".into();
    files.add_script("run.sh", runner(selection));
    name_links_in_scripts(&mut files);
    Ok(Export::new(files, record))
}

/// Ends of the names of MicMac's own files, and of those that viewrank writes beside the images.
const OWN_FILES: [&str; 5] = [".xml", ".txt", ".dat", ".sh", ".json"];

/// Names are relative to the working folder, a blank separates two of them, and Malt takes them as
/// regular expressions and hands them to a shell without quotes. The remaining characters need no
/// escape in XML.
fn check_name(name: &str) -> Result<(), BackendError> {
    let why = if name.contains(char::is_whitespace) {
        "a blank separates the two names of a pair"
    } else if name.contains('/') {
        "images are in the working folder itself"
    } else if OWN_FILES
        .iter()
        .any(|own| name.to_ascii_lowercase().ends_with(own))
    {
        "MicMac would read or write it as a file of its own"
    } else if name
        .contains(|c: char| c.is_ascii() && !c.is_ascii_alphanumeric() && !"._-".contains(c))
    {
        "Malt takes names as regular expressions and hands them to a shell: letters, digits, '.', '_' and '-' only"
    } else {
        return Ok(());
    };
    Err(BackendError::name("micmac", name, why))
}

/// Refuses key views that differ in the extension alone: their maps would be in one folder.
fn check_stems(selection: &Selection) -> Result<(), BackendError> {
    let mut keys = BTreeMap::new();
    for cluster in selection.clusters {
        let name = selection.scene.name(cluster.key);
        if let Some(other) = keys.insert(stem(name), name) {
            let why = format!(
                "without the extension, by which MicMac names the folder of a map, it is the same as {other}"
            );
            return Err(BackendError::name("micmac", name, why));
        }
    }
    Ok(())
}

fn pair_file(selection: &Selection) -> String {
    let mut xml = String::from("<?xml version=\"1.0\" ?>\n<SauvegardeNamedRel>\n");
    for cluster in selection.clusters {
        for &partner in &cluster.partners {
            let (key, partner) = (
                selection.scene.name(cluster.key),
                selection.scene.name(partner),
            );
            xml += &format!("  <Cple>{key} {partner}</Cple>\n");
        }
    }
    xml + "</SauvegardeNamedRel>\n"
}

/// Returns the secondary images as a single solution with a positive score, which Malt then takes.
fn secondary_images(selection: &Selection, cluster: &RankedCluster) -> String {
    let name = |v| selection.scene.name(v);
    let images: String = cluster
        .partners
        .iter()
        .map(|&p| format!("    <Images>{}</Images>\n", name(p)))
        .collect();
    format!(
        "<?xml version=\"1.0\" ?>\n<ImSecOfMaster>\n  <Master>{}</Master>\n  <Sols>\n{images}    <Coverage>1</Coverage>\n    <Score>1</Score>\n  \
         </Sols>\n</ImSecOfMaster>\n",
        name(cluster.key)
    )
}

fn masters(selection: &Selection) -> String {
    let names = selection
        .clusters
        .iter()
        .map(|c| format!("  <Name>{}</Name>\n", selection.scene.name(c.key)));
    format!(
        "<?xml version=\"1.0\" ?>\n<ListOfName>\n{}</ListOfName>\n",
        names.collect::<String>()
    )
}

/// Returns the script, described at its head. Malt uses the pattern of images as the name of the
/// master, so the pattern is the name itself.
fn runner(selection: &Selection) -> String {
    let mut script = ClusterScript::new(&[], RUNNER_HEAD);
    for cluster in selection.clusters {
        let name = selection.scene.name(cluster.key);
        let call = format!(
            "\"${{MM3D:-mm3d}}\" Malt GeomImage {} viewrank Master=AUTO",
            quoted(name)
        );
        let stem = stem(name);
        // MicMac takes the user's orientations, not the poses of the model, so the script adds
        // their checksum.
        let recipe = format!("\"{}-$orientations\"", recipe(selection, cluster, ""));
        let mark = quoted(&format!("MM-Malt-Img-{stem}/{MICMAC_MARK}"));
        let commands = [
            // First of all: a call that breaks off must not leave the mark of an earlier map.
            format!("rm -f {mark}"),
            call,
            format!("note {recipe} {mark}"),
        ];
        script.cluster(
            stem,
            &format!("[ \"$(cat {mark} 2>/dev/null)\" = {recipe} ]"),
            &commands,
        );
    }
    script.finish(&[])
}

const RUNNER_HEAD: &str = include_str!("../../integrations/micmac/run_head.sh");
