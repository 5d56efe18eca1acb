//! Exports of an earlier plan in the project: a new plan leaves them unchanged and reports them.

use serde::Deserialize;

use crate::{
    backends::{by_name, place},
    base::{input::FileKind, paths, shell::command_path},
    io::{
        output::{FileSet, read_own, recorded},
        project::Project,
    },
    plan::Plan,
};

/// The part of `export.json` that is compared with the plan.
#[derive(Deserialize)]
struct EarlierExport {
    backend: String,
    clusters: Vec<Cluster>,
}

#[derive(Deserialize)]
struct Cluster {
    key: View,
    partners: Vec<View>,
}

#[derive(Deserialize)]
struct View {
    name: String,
}

/// Returns one line for each folder in the project with an export of another ranking that `sets`
/// does not replace. Three or more share one line that names the first and counts the others.
pub(super) fn exports(plan: &Plan, project: &Project, sets: &[FileSet]) -> Vec<String> {
    let kept = |path: &String| {
        sets.iter()
            .all(|set| set.root != project.home || !set.files.contains_key(path))
    };
    let records = recorded(&project.home, "export-").into_iter();
    let mut lines: Vec<String> = records
        .filter(kept)
        .filter_map(|path| line(plan, project, &path))
        .collect();
    // Tiles of one export share a line.
    lines.dedup();
    if let [first, _, _, ..] = &lines[..] {
        let others = lines.len() - 1;
        lines = vec![format!("{first}; {others} more folders hold such exports")];
    }
    lines
}

fn line(plan: &Plan, project: &Project, record: &str) -> Option<String> {
    let (folder, in_tiles) = place::folder_of_record(record)?;
    let exported: EarlierExport =
        serde_json::from_slice(&read_own(&project.home, record, FileKind::Record).ok()?).ok()?;
    // The record may be anybody's: no word of it is printed but a known name.
    let backend = by_name(&exported.backend).ok()?.name;
    if is_part(&exported, plan) {
        return None;
    }
    let tiles = if in_tiles { " --tiles N" } else { "" };
    let folder = project.home.join(folder);
    let own = [
        project.output_folder().join(backend),
        project.output_folder().join(format!("{backend}-tiles")),
    ];
    let workspace = project
        .dense_workspace
        .as_deref()
        .filter(|_| backend == "colmap");
    let is_default = own.contains(&folder)
        || workspace.is_some_and(|workspace| paths::is_same(workspace, &folder));
    let out = if is_default {
        String::new()
    } else {
        format!(" --out {}", command_path(&folder))
    };
    let root = command_path(&project.home);
    let run = if is_default && backend == plan.stages.backend {
        format!("viewrank run {root} (which also matches), or ")
    } else {
        String::new()
    };
    Some(format!(
        "{} contains an export of an earlier plan for {backend}; to export this plan: {run}viewrank export {} --backend {backend}{tiles}{out}",
        folder.display(),
        root
    ))
}

/// Returns whether the clusters are a subsequence of the plan's ranking.
fn is_part(exported: &EarlierExport, plan: &Plan) -> bool {
    let name = |view| plan.stages.scene.name(view);
    let mut ranked = plan.ranked();
    exported.clusters.iter().all(|cluster| {
        // `any` goes on after the last match, and so finds a subsequence.
        ranked.any(|c| {
            let partners = c.partners.iter().map(|&partner| name(partner));
            cluster.key.name == name(c.key)
                && partners.eq(cluster.partners.iter().map(|view| view.name.as_str()))
        })
    })
}
