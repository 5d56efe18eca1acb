//! A plain list of images, for any program with a choice of images.

use super::{
    Backend, BackendError, Capabilities, Export, ExportOptions, ExportRecord, Honours, LastRun,
    PATCH_MATCH, PlanningNumbers, References, Selection,
};
use crate::model::{cluster::Gate, scene::ViewIndex};

pub static BACKEND: Backend = Backend {
    name: "images",
    aliases: &["image", "list", "imagelist"],
    program: "any program",
    last_run: LastRun::Never("a list of images"),
    capabilities: Capabilities {
        partners: Honours::No,
        key_subset: Honours::Yes,
        order: Honours::Yes,
        fusion: "the program's own",
        notes: "a list of names, best first; --refs keys+partners lists the partners too",
    },
    planning: ANY_PROGRAM,
    options: &["--refs"],
    use_of_views: Some("Take"),
    takes_distorted: true,
    export,
    reads_raw: true,
    ..Backend::DEFAULT
};

fn export(selection: &Selection, options: &ExportOptions) -> Result<Export, BackendError> {
    selection.refuse_unusable_images(BACKEND.name)?;
    let views = listed_views(selection, options.refs);
    let mut record = ExportRecord::new(&BACKEND, selection, |v| selection.scene.name(v).into());
    record.made_for = "any program".into();
    record.way = format!("{} images, best first", views.len());
    record.not_honoured = vec!["matching partners".into()];
    record.fusion = "the program's own".into();
    if selection.project.images.is_none() {
        record.warnings.push(
            "there is no image folder: the images were ranked by geometry alone, sharp or not"
                .into(),
        );
    }
    let mut files = options.file_set(&BACKEND, selection);
    let all = [&views[..], &selection.kept_for_tests()].concat();
    let (paths, folder) = selection.files_in_commands(&all, &files.root);
    let (chosen, tests) = paths.split_at(views.len());
    record.commands = vec![format!(
        "rsync -a --files-from=images.txt {folder}/ \"${{CHOSEN:?folder for the chosen images}}\"/"
    )];
    files.add_text("images.txt", lines(chosen));
    if !tests.is_empty() {
        files.add_text("test.txt", lines(tests));
    }
    Ok(Export::new(files, record))
}

/// Numbers for programs that choose pairs themselves: no pair is excluded, and a place should be in
/// several images.
pub(super) const ANY_PROGRAM: PlanningNumbers = PlanningNumbers {
    reach: None,
    gate: Gate::OPEN,
    support: 3,
    source: "no gate, since the program pairs images itself; the confidence is that of OpenMVS, not measured here; support 3: the chosen \
             images are all that RealityScan gets, so each place is to be seen by three",
    ..PATCH_MATCH
};

/// Returns the views for a program without partner lists, best first: the key views, each followed
/// by its partners if wanted, then all others if wanted but those kept for tests.
pub(super) fn listed_views(selection: &Selection, refs: Option<References>) -> Vec<ViewIndex> {
    let mut listed = vec![false; selection.scene.views.len()];
    let of_cluster = match refs {
        None | Some(References::Keys) => 1,
        _ => usize::MAX,
    };
    let clusters = selection.clusters.iter();
    let mut views: Vec<_> = clusters
        .flat_map(|cluster| cluster.views().take(of_cluster))
        .filter(|v| !std::mem::replace(&mut listed[v.index()], true))
        .collect();
    if refs == Some(References::All) {
        let tests = selection.kept_for_tests();
        tests.iter().for_each(|v| listed[v.index()] = true);
        views.extend(
            selection
                .scene
                .view_indices()
                .filter(|v| !listed[v.index()]),
        );
    }
    views
}

pub(super) fn name_lines(selection: &Selection, views: &[ViewIndex]) -> String {
    let names = views.iter().map(|&v| selection.scene.name(v));
    names.map(|name| name.to_owned() + "\n").collect()
}

fn lines(paths: &[String]) -> String {
    paths.iter().map(|path| path.clone() + "\n").collect()
}
