//! `viewrank export`: writes a plan for other backends, or with another cut, without planning again.

use std::path::{Path, PathBuf};

use clap::Args;
use serde::Serialize;
use viewrank::{
    backends::{
        self, Backend, BackendError, Export, ExportOptions, ExportRecord, RankedCluster, References, Selection,
    },
    config::{Budget, Share},
    manifest::WrittenPlan,
    output::{Disk, FileSet, Written},
    project::Project,
    tiles,
};

use super::{Failure, Format, json, print};

/// Write what MVS programs need to compute the chosen view clusters of a plan.
///
/// Takes the ranking of PROJECT/viewrank/manifest.json (viewrank plan makes it); viewrank backends lists the programs. Without --out the
/// files go to PROJECT/viewrank/NAME, those for COLMAP into the project's dense workspace where there is one.
#[derive(Args)]
pub struct Arguments {
    project: PathBuf,

    /// Programs to write for [default: the one that the plan was made for]
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    backend: Vec<String>,
    /// The first N view clusters, or as many as P % of the registered views [default: the plan's cut]
    #[arg(long, value_name = "N|P%")]
    budget: Option<Budget>,
    /// The fewest view clusters that reach P % of what all together reach [default: the plan's cut]
    #[arg(long, value_name = "P%")]
    target: Option<Share>,
    /// Folder to write to; with several backends each gets a folder of its name in it
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,

    /// Part the view clusters by area: a project for each of N tiles of about as many clusters, in OUT/tile_01 and so on, with the
    /// partners from beyond its borders
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..), conflicts_with = "scene")]
    tiles: Option<u32>,

    /// COLMAP: views that get depth maps. Programs without partner lists: views that are listed
    #[arg(long, value_enum, value_name = "WHICH", help_heading = "Of some backends")]
    refs: Option<References>,
    /// COLMAP: geometric consistency, which needs depth maps of the partners
    #[arg(long, value_name = "on|off", value_parser = switch, help_heading = "Of some backends")]
    geometric: Option<bool>,
    /// OpenMVS: the plain list of neighbours for this scene.mvs, instead of a scene per cluster
    #[arg(long, value_name = "SCENE.mvs", help_heading = "Of some backends")]
    scene: Option<PathBuf>,
    /// OpenMVS with --scene: a copy of the scene at a size that OpenMVS's depth range fits
    #[arg(long, requires = "scene", help_heading = "Of some backends")]
    scale: bool,

    /// Say what would be written, and write nothing
    #[arg(long, help_heading = "Output")]
    dry_run: bool,
    #[arg(long, value_enum, default_value_t, help_heading = "Output")]
    format: Format,
}

fn switch(text: &str) -> Result<bool, String> {
    match text {
        "on" => Ok(true),
        "off" => Ok(false),
        _ => Err("on or off".into()),
    }
}

/// What an export did, for programs.
#[derive(Serialize)]
pub struct Report {
    folder: PathBuf,
    files: usize,
    written: Written,
    #[serde(flatten)]
    record: ExportRecord,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let plan = WrittenPlan::read(&arguments.project)?;
    let backends = arguments.backends(&plan).map_err(Failure::usage)?;
    let clusters = &plan.clusters[..plan.cut_at(arguments.budget, arguments.target)];
    let selection = Selection {
        project: &plan.project,
        scene: &plan.scene,
        clusters,
        image_scale: plan.settings.image_scale,
        planned_for: &plan.backend,
    };
    if let Some(tiles) = arguments.tiles {
        return export_tiles(arguments, &selection, &backends, tiles as usize, &plan);
    }
    // All are made before any is written: a name that one of them cannot take stops the others too.
    let export = |backend: &&dyn Backend| backend.export(&selection, &arguments.options(*backend, backends.len()));
    let exports: Vec<Export> = backends.iter().map(export).collect::<Result<_, BackendError>>()?;
    exports.iter().try_for_each(|export| spare_own_files(&export.files, &plan.project))?;
    let reports = exports.into_iter().map(|export| write(export, &plan, arguments.dry_run));
    let reports: Vec<Report> = reports.collect::<Result<_, Failure>>()?;
    match arguments.format {
        Format::Json => print(&json(&reports)),
        Format::Text => reports.iter().try_for_each(|report| print(&report.text())),
    }
}

impl Arguments {
    fn backends(&self, plan: &WrittenPlan) -> Result<Vec<&'static dyn Backend>, BackendError> {
        let planned_for = std::slice::from_ref(&plan.backend);
        let names = if self.backend.is_empty() { planned_for } else { &self.backend };
        let backends: Vec<_> = names.iter().map(|name| backends::by_name(name)).collect::<Result<_, _>>()?;
        let given = [
            ("--refs", self.refs.is_some()),
            ("--geometric", self.geometric.is_some()),
            ("--scene", self.scene.is_some()),
        ];
        for (option, _) in given.iter().filter(|(_, given)| *given) {
            if !backends.iter().any(|b| b.options().contains(option)) {
                return Err(BackendError::Option { option, backends: names.join(", ") });
            }
        }
        Ok(backends)
    }

    fn options(&self, backend: &dyn Backend, backends: usize) -> ExportOptions {
        let out = self.out.as_ref().map(|out| if backends > 1 { out.join(backend.name()) } else { out.clone() });
        let scene = self.scene.clone();
        ExportOptions { out, refs: self.refs, geometric: self.geometric, scene, scale: self.scale }
    }
}

/// Exports a project per backend and tile.
fn export_tiles(
    arguments: &Arguments,
    selection: &Selection,
    backends: &[&'static dyn Backend],
    count: usize,
    plan: &WrittenPlan,
) -> Result<(), Failure> {
    let parts = tiles::of_clusters(selection, count);
    for backend in backends {
        let options = arguments.options(*backend, backends.len());
        let named = format!("{}-tiles", backend.name());
        let folder = options.out.clone().unwrap_or_else(|| plan.project.output_folder().join(&named));
        let export = |(i, clusters): (usize, &Vec<RankedCluster>)| {
            let out = Some(folder.join(format!("tile_{:02}", i + 1)));
            backend.export(&Selection { clusters, ..*selection }, &ExportOptions { out, ..options.clone() })
        };
        let exports = parts.iter().enumerate().map(export).collect::<Result<Vec<Export>, BackendError>>()?;
        // In one set, so that tiles of an earlier export with more of them go.
        let in_project = folder.starts_with(&plan.project.root);
        let mut set = FileSet::new(if in_project { &plan.project.root } else { &folder }, &format!("export-{named}"));
        let mut text = String::new();
        for (Export { files, record }, clusters) in exports.into_iter().zip(&parts) {
            spare_own_files(&files, &plan.project)?;
            let command = record.runner.as_ref().or(record.commands.first()).cloned().unwrap_or_default();
            text += &format!("{}: {} view clusters; run there {command}\n", files.root.display(), clusters.len());
            set.absorb(files);
        }
        if !arguments.dry_run {
            set.write(&Disk::REAL)?;
        }
        print(&text)?;
    }
    Ok(())
}

/// Refuses what would lie among the images of the project or in place of its model: links to images would lead in circles there, and the next
/// plan would be made from the model of this one.
fn spare_own_files(files: &FileSet, project: &Project) -> Result<(), BackendError> {
    let place = |path: &Path| match (path.parent().and_then(|folder| folder.canonicalize().ok()), path.file_name()) {
        (Some(folder), Some(name)) => folder.join(name),
        _ => path.to_path_buf(),
    };
    let folder = |path: &Path| path.canonicalize().unwrap_or_else(|_| path.to_path_buf());
    // Images beside everything else of a project do not make all of it a folder of images.
    let images = project.images.as_deref().map(folder).filter(|images| !folder(&project.root).starts_with(images));
    let model: Vec<PathBuf> = project.model_files().iter().map(|file| place(file)).collect();
    let is_own = |path: &PathBuf| {
        let path = place(path);
        let is_model = model.iter().any(|file| file.with_extension("") == path.with_extension(""));
        is_model || images.as_ref().is_some_and(|images| path.starts_with(images))
    };
    match files.files.keys().map(|name| files.root.join(name)).find(is_own) {
        Some(path) => Err(BackendError::OwnFile(path)),
        None => Ok(()),
    }
}

/// Files in the project belong to a set of the project, like those of `viewrank plan`: the one follows the other.
pub fn write(export: Export, plan: &WrittenPlan, dry_run: bool) -> Result<Report, Failure> {
    let Export { files, record } = export;
    let folder = files.root.clone();
    let count = files.files.len();
    let mut in_project = FileSet::new(&plan.project.root, &format!("export-{}", record.backend));
    let set = in_project.absorb(files).unwrap_or(in_project);
    let written = if dry_run { Written::default() } else { set.write(&Disk::REAL)? };
    Ok(Report { folder, files: count, written, record })
}

impl Report {
    fn text(&self) -> String {
        let r = &self.record;
        let mut text = format!(
            "{}: {} view clusters, {} files in {}\n",
            r.backend,
            r.clusters.len(),
            self.files,
            self.folder.display()
        );
        text += &format!("  for          {}\n  way          {}\n", r.made_for, r.way);
        if r.other_maps > 0 {
            text += &format!("  depth maps   {} of key views and {} of others\n", r.key_maps, r.other_maps);
        }
        match &r.runner {
            Some(runner) => text += &format!("  run there    ./{runner}\n"),
            None => r.commands.iter().for_each(|command| text += &format!("  run there    {command}\n")),
        }
        r.not_honoured.iter().for_each(|what| text += &format!("  not honoured {what}\n"));
        r.warnings.iter().for_each(|warning| text += &format!("  warning      {warning}\n"));
        self.written.kept.iter().for_each(|kept| text += &format!("  kept         {kept}: a file that was not ours\n"));
        text
    }
}
