//! `viewrank export`: writes a plan for other backends, or with another cut, without planning
//! again.

use std::path::{Path, PathBuf};

use crate::backends::clusters_by_area;
use crate::{
    apps::dispatch::Dispatch,
    backends::{
        self, Backend, BackendError, Export, ExportOptions, ExportRecord, References, Selection,
        place,
    },
    config::{Budget, Share},
    io::{output::WriteReport, project::Project},
    model::cluster::RankedCluster,
    show::manifest::WrittenPlan,
};
use clap::{Args, builder::PossibleValue};
use serde::Serialize;

use super::{Exit, Failure, Format, print, print_json, warn, wrapped};

/// Write the input files of MVS programs for the chosen view clusters of a plan.
///
/// Reads the ranking from PROJECT/viewrank/manifest.json (written by viewrank plan); viewrank
/// backends lists the programs. Without --out the files go to PROJECT/viewrank/NAME, those for
/// COLMAP into the project's dense workspace where there is one.
#[derive(Args)]
pub struct Arguments {
    /// Folder of the project, or its model
    #[arg(value_parser = super::arguments::project())]
    project: PathBuf,

    #[arg(long, value_name = "NAME,...", value_delimiter = ',', help = super::backends::option_help("Backends to write for", "the plan's"))]
    backend: Vec<String>,
    /// Take the first N view clusters, or P % of the number of registered views (of a plan of two
    /// sizes: of the work of all) [default: the plan's cut]
    #[arg(long, value_name = "N|P%")]
    budget: Option<Budget>,
    /// Take the fewest view clusters that reach P % of what all together reach [default: the plan's
    /// cut]; for splat and images, of a plan for one of them
    #[arg(long, value_name = "P%")]
    target: Option<Share>,
    /// Folder to write to; with several backends each gets a folder of its name in it
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,

    /// Split the view clusters by area into N projects of about equal size (at most one per
    /// cluster), in OUT/tile_01 and so on, each with the partners from beyond its borders
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..), conflicts_with = "scene")]
    tiles: Option<u32>,

    /// COLMAP: views that get depth maps. Programs without partner lists: views that are listed
    #[arg(
        long,
        value_enum,
        value_name = "WHICH",
        help_heading = "For some backends"
    )]
    refs: Option<References>,
    /// COLMAP: geometric consistency, which needs depth maps of the partners
    #[arg(long, value_name = "on|off", value_parser = switch, help_heading = "For some backends")]
    geometric: Option<bool>,
    /// OpenMVS: the plain list of neighbours for this scene.mvs, instead of a scene per cluster
    #[arg(long, value_name = "SCENE.mvs", help_heading = "For some backends")]
    scene: Option<PathBuf>,
    /// OpenMVS with --scene: a copy of the scene at a size that OpenMVS's depth range fits
    #[arg(long, requires = "scene", help_heading = "For some backends")]
    scale: bool,

    /// Print what would be written; write nothing
    #[arg(long, help_heading = "Output")]
    dry_run: bool,
    /// Format of the results on stdout
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

/// JSON output: files written for a backend.
#[derive(Serialize)]
struct Report {
    folder: PathBuf,
    files: usize,
    written: WriteReport,
    /// Typed options that the backend ignores.
    unheeded: Vec<&'static str>,
    #[serde(flatten)]
    what: What,
}

#[derive(Serialize)]
#[serde(untagged)]
enum What {
    Whole(Box<ExportRecord>),
    Tiles { backend: String, tiles: Vec<Tile> },
}

#[derive(Serialize)]
struct Tile {
    folder: PathBuf,
    files: usize,
    #[serde(flatten)]
    record: ExportRecord,
}

/// Exports to write for a backend: one, or one per tile.
struct PreparedExport {
    folder: PathBuf,
    exports: Vec<Export>,
    unheeded: Vec<&'static str>,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let plan = WrittenPlan::read(&arguments.project)?;
    let backends = arguments.backends(&plan)?;
    arguments.refuse_other_share(&backends, &plan)?;
    let clusters = &plan.clusters[..plan.cut_at(arguments.budget, arguments.target)];
    warn_of_end(arguments, &plan, clusters.len());
    if arguments.out.is_none() && backends.iter().any(|b| b.name == plan.backend) {
        warn_of_other_end(&plan, clusters.len());
    }
    let image_faults = plan.project.image_faults(&plan.scene);
    let selection = plan.selection(clusters, &image_faults);
    let tiles = arguments.tiles.map(|count| tiles(&selection, count));
    // All exports are built and checked before any is written: an error in one stops the others,
    // too.
    let make =
        |backend: &&Backend| arguments.make(backend, backends.len(), &selection, tiles.as_deref());
    let made: Vec<PreparedExport> = backends
        .iter()
        .map(make)
        .collect::<Result<_, BackendError>>()?;
    made.iter()
        .try_for_each(|made| place::check(&made.folder, &made.exports, &plan.project))?;
    for (made, backend) in made.iter().zip(&backends).filter(|_| !arguments.dry_run) {
        refuse_if_run_is_in(&made.folder, backend, &plan.project)?;
    }
    let reports = made
        .into_iter()
        .map(|made| made.write(&plan.project, tiles.is_some(), arguments.dry_run));
    let reports: Vec<Report> = reports.collect::<Result<_, Failure>>()?;
    match arguments.format {
        Format::Json => print_json(&reports),
        Format::Text => reports
            .iter()
            .try_for_each(|report| print(report.text(arguments.dry_run))),
    }
}

/// The clusters of each tile; warns if there are fewer than `count`.
fn tiles(selection: &Selection, count: u32) -> Vec<Vec<RankedCluster>> {
    let tiles = clusters_by_area(selection, count as usize);
    if tiles.len() < count as usize {
        warn(&format!(
            "the key views of the plan fill only {} of {count} tiles",
            tiles.len()
        ));
    }
    tiles
}

/// Refuses to write into the folder in which `viewrank run` works, while it does.
fn refuse_if_run_is_in(folder: &Path, backend: &Backend, project: &Project) -> Result<(), Failure> {
    let own = std::path::absolute(project.output_folder().join(backend.name));
    if own.is_ok_and(|own| std::path::absolute(folder).is_ok_and(|folder| folder == own)) {
        Dispatch::refuse_if_at_work_with(backend, project)?;
    }
    Ok(())
}

/// Warns if the list of the plan ends below the wanted share, and of another end than the plan's at
/// two sizes, which are chosen for that.
fn warn_of_end(arguments: &Arguments, plan: &WrittenPlan, length: usize) {
    let wanted = arguments.target.zip(plan.clusters.last());
    let missed =
        wanted.filter(|(target, last)| length == plan.clusters.len() && last.share < target.0);
    if let Some((target, last)) = missed {
        let made = match backends::by_name(&plan.backend) {
            Ok(backend) if !backend.makes_maps() => "images of the plan draw",
            _ => "depth maps of the plan give",
        };
        warn(&format!(
            "all {length} {made} {:.1} %, less than --target: plan again with --target {}",
            100.0 * last.share,
            String::from(target)
        ));
    } else if plan.settings.ranking.has_half() && length != plan.cut {
        warn(
            "the sizes were chosen for the target or budget of the plan: for another one, plan again with it",
        );
    }
}

/// Warns of files of another length than the plan's, where `status` and `evaluate` look for the
/// plan's.
fn warn_of_other_end(plan: &WrittenPlan, length: usize) {
    if length != plan.cut {
        let what = match backends::by_name(&plan.backend) {
            Ok(backend) if !backend.makes_maps() => "images",
            _ => "view clusters",
        };
        let tests = plan.settings.test_every;
        let tests = tests.map_or_else(String::new, |every| format!(" --test-every {every}"));
        warn(&format!(
            "the plan stops at {} {what}, and `viewrank status` counts those; to plan {length}: viewrank plan {} --budget {length}{tests}",
            plan.cut,
            plan.project.as_argument()
        ));
    }
}

impl Arguments {
    fn backends(&self, plan: &WrittenPlan) -> Result<Vec<&'static Backend>, BackendError> {
        let planned_for = std::slice::from_ref(&plan.backend);
        let names = if self.backend.is_empty() {
            planned_for
        } else {
            &self.backend
        };
        let backends = backends::by_names(names)?;
        for option in self.given() {
            if !backends.iter().any(|b| b.options.contains(&option)) {
                return Err(BackendError::Option {
                    option,
                    backends: names.join(", "),
                });
            }
        }
        Ok(backends)
    }

    /// Fails if the share of --target is not what a backend would count: how much fusion keeps of
    /// depth maps says nothing of images that a program uses themselves.
    fn refuse_other_share(
        &self,
        backends: &[&'static Backend],
        plan: &WrittenPlan,
    ) -> Result<(), Failure> {
        let planned_for = backends::by_name(&plan.backend)?;
        let is_other = |b: &&&'static Backend| b.makes_maps() != planned_for.makes_maps();
        let (Some(target), Some(other)) = (self.target, backends.iter().find(is_other)) else {
            return Ok(());
        };
        let counted = if planned_for.makes_maps() {
            "depth maps"
        } else {
            "images"
        };
        let message = format!(
            "--target counts {counted} in this plan, which was made for {}",
            planned_for.name
        );
        let hint = format!(
            "plan for {name}: viewrank plan {} --backend {name} --target {}",
            plan.project.as_argument(),
            String::from(target),
            name = other.name,
        );
        Err(Failure::new(Exit::Usage, message, hint))
    }

    /// Typed options of some backends.
    fn given(&self) -> impl Iterator<Item = &'static str> {
        let all = [
            ("--refs", self.refs.is_some()),
            ("--geometric", self.geometric.is_some()),
            ("--scene", self.scene.is_some()),
        ];
        all.into_iter()
            .filter(|(_, given)| *given)
            .map(|(option, _)| option)
    }

    fn options(&self, backend: &Backend, backends: usize) -> ExportOptions {
        let out = self.out.as_ref().map(|out| {
            if backends > 1 {
                out.join(backend.name)
            } else {
                out.clone()
            }
        });
        let scene = self.scene.clone();
        ExportOptions {
            out,
            refs: self.refs,
            geometric: self.geometric,
            scene,
            scale: self.scale,
        }
    }

    fn make(
        &self,
        backend: &Backend,
        backends: usize,
        selection: &Selection,
        tiles: Option<&[Vec<RankedCluster>]>,
    ) -> Result<PreparedExport, BackendError> {
        let options = self.options(backend, backends);
        let unheeded = self
            .given()
            .filter(|option| !backend.options.contains(option))
            .collect();
        let Some(tiles) = tiles else {
            let export = backend.export(selection, &options)?;
            return Ok(PreparedExport {
                folder: export.files.root.clone(),
                exports: vec![export],
                unheeded,
            });
        };
        let own = || {
            selection
                .project
                .output_folder()
                // A folder of its own: the files of an export replace those that its folder had.
                .join(format!("{}-tiles", backend.name))
        };
        let folder = options.out.clone().unwrap_or_else(own);
        let export = |(i, clusters): (usize, &Vec<RankedCluster>)| {
            // `place` knows an export in tiles by the name of its first folder.
            let out = Some(folder.join(format!("tile_{:02}", i + 1)));
            backend.export(
                &Selection {
                    clusters,
                    ..*selection
                },
                &ExportOptions {
                    out,
                    ..options.clone()
                },
            )
        };
        let exports = tiles
            .iter()
            .enumerate()
            .map(export)
            .collect::<Result<_, _>>()?;
        Ok(PreparedExport {
            folder,
            exports,
            unheeded,
        })
    }
}

impl PreparedExport {
    /// Tiles are written together, and surplus tiles of an earlier export are removed.
    fn write(self, project: &Project, in_tiles: bool, dry_run: bool) -> Result<Report, Failure> {
        let mut sets = Vec::new();
        let mut tiles = Vec::new();
        for Export { files, record } in self.exports {
            tiles.push(Tile {
                folder: files.root.clone(),
                files: files.files.len(),
                record,
            });
            sets.push(files);
        }
        let set = place::set_of_folder(&self.folder, sets, project);
        let written = if dry_run {
            WriteReport::default()
        } else {
            set.write(&project.disk())?
        };
        let what = match tiles.pop() {
            Some(only) if !in_tiles => What::Whole(Box::new(only.record)),
            last => {
                tiles.extend(last);
                let backend = tiles
                    .first()
                    .map(|tile| tile.record.backend.clone())
                    .unwrap_or_default();
                What::Tiles { backend, tiles }
            }
        };
        Ok(Report {
            folder: self.folder,
            files: set.files.len(),
            written,
            unheeded: self.unheeded,
            what,
        })
    }
}

impl Report {
    fn text(&self, dry_run: bool) -> Vec<String> {
        let mut lines: Vec<String> = match &self.what {
            What::Whole(record) => described(record, self.files, &self.folder, dry_run),
            What::Tiles { tiles, .. } => tiles
                .iter()
                .flat_map(|tile| described(&tile.record, tile.files, &tile.folder, dry_run))
                .collect(),
        };
        lines.extend(
            self.unheeded
                .iter()
                .map(|option| format!("  not for it   {option}")),
        );
        if let Some(first) = self.written.removed.first() {
            let more = if self.written.removed.len() > 1 {
                ", ..."
            } else {
                ""
            };
            let count = self.written.removed.len();
            lines.push(format!(
                "  removed      {count} files of an earlier export: {first}{more}"
            ));
        }
        lines.extend(
            self.written
                .kept
                .iter()
                .map(|kept| format!("  kept         {kept}: not written by viewrank")),
        );
        lines
    }
}

fn described(r: &ExportRecord, files: usize, folder: &Path, dry_run: bool) -> Vec<String> {
    let would = if dry_run { "would be " } else { "" };
    let folder = folder.display();
    let matched = backends::by_name(&r.backend).is_ok_and(|backend| backend.makes_maps());
    let what = if matched { "view clusters" } else { "images" };
    let what = if r.clusters.len() == 1 {
        what.trim_end_matches('s')
    } else {
        what
    };
    let mut lines = vec![
        format!(
            "{}: {} {what}, {files} files {would}in {folder}",
            r.backend,
            r.clusters.len()
        ),
        format!("  for          {}", r.made_for),
        format!("  way          {}", r.way),
    ];
    if r.other_maps > 0 {
        lines.push(format!(
            "  depth maps   {} of key views and {} of others",
            r.key_maps, r.other_maps
        ));
    }
    match &r.runner {
        Some(runner) => lines.push(format!("  run there    ./{runner}")),
        None => lines.extend(
            r.commands
                .iter()
                .map(|command| format!("  run there    {command}")),
        ),
    }
    lines.extend(
        r.not_honoured
            .iter()
            .flat_map(|what| wrapped("  not honoured ", what)),
    );
    lines.extend(
        r.warnings
            .iter()
            .flat_map(|warning| wrapped("  warning      ", warning)),
    );
    lines
}

impl clap::ValueEnum for References {
    fn value_variants<'a>() -> &'a [Self] {
        &[Self::Keys, Self::KeysAndPartners, Self::All]
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        Some(match self {
            Self::Keys => PossibleValue::new("keys").help("The key views"),
            Self::KeysAndPartners => PossibleValue::new("keys+partners")
                .help("The key views and, photometric only, their partners: what geometric consistency needs"),
            Self::All => PossibleValue::new("all").help("Every view of the model, key views first"),
        })
    }
}
