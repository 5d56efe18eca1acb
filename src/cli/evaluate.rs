//! `viewrank evaluate`: measures finished depth maps against the plan, a reference, and other
//! choices.

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
};

use crate::{
    apps::{
        doctor::counted,
        evaluate::{
            self, CloudComparison, Evaluation, EvaluationInput, EvaluationOptions,
            MeasuredClusters, MeasuredProgress, MeasuredSurface, baselines, clusters, orders,
            other_sizes_in_words,
        },
        replan,
        report::own_folder_of_maps,
    },
    backends,
    base::{printable::to_json, shell::shown_path},
    daemon::{follow::follow, state::Outcome},
    io::{
        depthmaps,
        output::{Contents, Disk, FileSet, refuse_to_leave},
        project::Project,
    },
    model::scene::ViewIndex,
    plan::Plan,
};
use clap::Args;
use serde::Serialize;

use super::{
    Exit, Failure, Format, print_json, print_sentences, progress::ProgressDisplay, use_threads,
    warn,
};

/// Measure finished depth maps: quality reached, what is missing and why.
///
/// Needs a plan of PROJECT (viewrank plan). The depth maps are those of COLMAP (stereo/depth_maps),
/// OpenMVS, MVSNet, ACMM, Gipuma, MVE, AliceVision, MicMac or integrations/sgm. Writes
/// PROJECT/viewrank/evaluation/: evaluation.html, evaluation.json, evaluation.ply, and cells.tsv,
/// which says which maps take part in which cells of their fused cloud. Where no depth maps are
/// found, or with --cells, the plan's order is judged by that table. Of the maps of the plan's
/// program, viewrank/progress.json has the share reached, for viewrank status.
#[derive(Args)]
pub struct Arguments {
    /// Folder of the project, or its model
    #[arg(value_parser = super::arguments::project())]
    project: PathBuf,

    /// Folder of the finished depth maps [default: where the plan's program writes them]
    #[arg(long, value_name = "DIR", value_parser = super::arguments::folder())]
    depth_maps: Option<PathBuf>,
    /// Folder of reference depth maps, such as those with all partners [default: every depth counts
    /// as right]
    #[arg(long, value_name = "DIR", value_parser = super::arguments::folder())]
    reference: Option<PathBuf>,
    /// Fused cloud of a full run, to compare --cloud with: area, completeness, precision, error
    /// (PLY)
    #[arg(long, value_name = "FILE", requires = "cloud")]
    reference_cloud: Option<PathBuf>,
    /// Fused cloud of these depth maps (PLY); orders are judged by its cells if it says which maps
    /// made its points, as those of OpenMVS (FILE.mvs beside it) and COLMAP (FILE.ply.vis) do
    /// [default: the one beside the maps, if it is newer]
    #[arg(long, value_name = "FILE", requires = "depth_maps")]
    cloud: Option<PathBuf>,
    /// File of the view clusters that the maps were made for, in order [default: the plan's]
    #[arg(long, value_name = "FILE", requires = "depth_maps")]
    clusters: Option<PathBuf>,
    /// Table of an earlier evaluation, to judge the plan's order by [default:
    /// PROJECT/viewrank/evaluation/cells.tsv]
    #[arg(long, value_name = "FILE", conflicts_with = "depth_maps")]
    cells: Option<PathBuf>,
    /// Folder of depth maps of the same clusters, matched at half the size, to compare with
    #[arg(long, value_name = "DIR", value_parser = super::arguments::folder(), requires = "depth_maps")]
    half_size: Option<PathBuf>,
    /// Also compare the order with others by each triangle (with --depth-maps): without prediction,
    /// updated by results, replanned, most sparse points, every n-th, farthest view, random,
    /// optimum
    #[arg(long, requires = "depth_maps")]
    baselines: bool,

    /// Also write the tables of the plan and of the real fulfilment as NumPy files
    #[arg(long, value_name = "DIR", requires = "depth_maps")]
    dump_tables: Option<PathBuf>,
    /// Folder for the results [default: PROJECT/viewrank/evaluation]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Threads to use [default: all]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
    /// No progress and no summary
    #[arg(long, short)]
    quiet: bool,
    /// Format of the results on stdout
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

/// Name of the table of cells.
const CELLS: &str = "cells.tsv";

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    use_threads(arguments.threads);
    let progress = ProgressDisplay::new(arguments.quiet);
    let (project, plan, _) = replan::as_written(&arguments.project, &progress)?;
    match &arguments.depth_maps {
        Some(folder) => {
            record(arguments, &plan, &project, folder, &progress);
            measure(arguments, &project, &plan, folder, &progress)
        }
        None => match found_maps(arguments, &project, &plan) {
            // Else what was measured of other maps would be said of these.
            Some(folder) => {
                if Some(&folder) != own_folder_of_maps(&plan, &project).as_ref() {
                    warn(&format!(
                        "{} has made no depth maps for this plan: those of another program are measured, in {}",
                        plan.stages.backend,
                        folder.display()
                    ));
                }
                record(arguments, &plan, &project, &folder, &progress);
                measure(arguments, &project, &plan, &folder, &progress)
            }
            None => judge(arguments, &project, &plan, &progress),
        },
    }
}

/// Records how far the maps of the plan's program have come, as `run` and `watch` do, so that
/// `status` and queues know.
fn record(
    arguments: &Arguments,
    plan: &Plan,
    project: &Project,
    folder: &Path,
    progress: &ProgressDisplay,
) {
    let place = |folder: &Path| folder.canonicalize().ok();
    let own = own_folder_of_maps(plan, project).filter(|own| place(own) == place(folder));
    // Maps measured against anything but the plan are no progress of it.
    let is_other = arguments.reference.is_some() || arguments.clusters.is_some();
    let Some(own) = own.filter(|_| !is_other && arguments.out.is_none()) else {
        return;
    };
    let known = backends::known_maps(plan.stages.backend, &own);
    if let Outcome::Failed { reason, .. } = follow(&project.home, &known, progress) {
        warn(&format!("status is not told what was measured: {reason}"));
    }
}

/// Returns the folders that may hold depth maps, that of the plan's backend first.
fn folders_of_maps(plan: &Plan, project: &Project) -> Vec<PathBuf> {
    let own = own_folder_of_maps(plan, project);
    let mut folders = depthmaps::folders(&project.home);
    folders.sort_by_key(|folder| Some(folder) != own.as_ref());
    folders
}

/// Returns the folder with depth maps of the plan, unless a table is named.
fn found_maps(arguments: &Arguments, project: &Project, plan: &Plan) -> Option<PathBuf> {
    if arguments.cells.is_some() {
        return None;
    }
    folders_of_maps(plan, project)
        .into_iter()
        .find(|folder| depthmaps::find(folder, &plan.stages.scene).is_ok())
}

fn kept_cells(project: &Project) -> PathBuf {
    project.output_folder().join("evaluation").join(CELLS)
}

/// Judges the order of the plan by a table of an earlier evaluation.
fn judge(
    arguments: &Arguments,
    project: &Project,
    plan: &Plan,
    progress: &ProgressDisplay,
) -> Result<(), Failure> {
    let kept = || kept_cells(project);
    let path = arguments.cells.clone().unwrap_or_else(kept);
    if arguments.cells.is_none() && !plan.stages.makes_maps {
        let backend = plan.stages.backend;
        let message =
            format!("the plan chooses images for {backend}: there are no depth maps to evaluate");
        let hint = "keep images apart for tests (viewrank plan --test-every 8), and measure what the program draws of them";
        return Err(Failure::new(Exit::Usage, message, Some(hint.into())));
    }
    if arguments.cells.is_none() && !path.is_file() {
        let hint = "name the folder of the finished depth maps with --depth-maps";
        let message = "nothing to evaluate: no finished depth maps were found";
        return Err(Failure::new(Exit::Usage, message, Some(hint.into())));
    }
    let judged = evaluate::cells::judge_plan(plan, &path, progress)?;
    progress.finish();
    output(arguments, &judged, || judged.lines())
}

fn measure(
    arguments: &Arguments,
    project: &Project,
    plan: &Plan,
    folder: &Path,
    progress: &ProgressDisplay,
) -> Result<(), Failure> {
    let out = arguments
        .out
        .clone()
        .unwrap_or_else(|| project.output_folder().join("evaluation"));
    refuse_to_leave(&project.home, &out)?;
    let clusters = match &arguments.clusters {
        Some(file) => clusters::read(file, &plan.stages.scene)?,
        None => orders::of_plan(plan).cloned().collect(),
    };
    let reference = arguments.reference.as_deref();
    let input = EvaluationInput::new(&plan.stages, &clusters, folder, reference);
    let run = MeasuredClusters::new(&input, progress)?;
    let model = plan.stages.model();
    let reached = MeasuredSurface::new(&model, &run);
    let half = |folder: &PathBuf| {
        MeasuredClusters::at_half_size(&plan.stages, &clusters, folder, reference, progress)
    };
    let half = arguments.half_size.as_ref().map(half).transpose()?;
    let cloud = arguments.cloud.as_deref();
    let cells = evaluate::cells::incidence(&plan.stages, &run, folder, cloud, progress)?;
    let cell_table = cells.0.text();
    let how = EvaluationOptions {
        all_maps: plan.decision.forecast.all_maps,
        objective: &plan.stages.objective,
        pilot: plan.stages.pilot.as_ref(),
        cells,
        baselines: arguments.baselines,
        so_far: MeasuredProgress::new(&plan.stages, &run),
        clouds: compared_clouds(arguments, plan)?,
        half: half.as_ref(),
    };
    let evaluation = Evaluation::new(&model, &run, &reached, &how, progress)?;
    let mut files = FileSet::new(&out, "evaluation");
    files.add_text("evaluation.json", to_json(&evaluation));
    files.add_text(CELLS, cell_table);
    files.add_text(
        "evaluation.html",
        evaluate::page(&evaluation, &project.name()),
    );
    files.add("evaluation.ply", Contents::Bytes(reached.ply(&model)));
    files.write(&project.disk())?;
    if let Some(folder) = &arguments.dump_tables {
        let mut set = FileSet::new(folder, "tables");
        evaluate::tables::add(plan, &run, &mut set);
        // Not limited to the project: the user has named the folder.
        set.write(&Disk::REAL)?;
    }
    progress.finish();
    warnings(plan, &evaluation, &run);
    output(arguments, &evaluation, || text(&evaluation, folder, &out))
}

fn compared_clouds(arguments: &Arguments, plan: &Plan) -> Result<Option<CloudComparison>, Failure> {
    let (Some(cloud), Some(reference)) = (&arguments.cloud, &arguments.reference_cloud) else {
        return Ok(None);
    };
    let gsd = plan.stages.settings.target.gsd;
    let gsd = gsd.expect("a plan's settings are filled in");
    Ok(Some(CloudComparison::read(cloud, reference, gsd)?))
}

fn output(
    arguments: &Arguments,
    value: &impl Serialize,
    text: impl Fn() -> Vec<String>,
) -> Result<(), Failure> {
    match arguments.format {
        Format::Json => print_json(value),
        Format::Text if arguments.quiet => Ok(()),
        Format::Text => print_sentences(text()),
    }
}

fn warnings(plan: &Plan, evaluation: &Evaluation, run: &MeasuredClusters) {
    let listed: BTreeSet<ViewIndex> = plan
        .ranked()
        .take(plan.decision.cut.clusters)
        .map(|c| c.key)
        .collect();
    let missing = run
        .without_map
        .iter()
        .filter(|key| listed.contains(*key))
        .count();
    if missing > 0 {
        let are = if missing == 1 { "is" } else { "are" };
        warn(&format!(
            "{missing} of the {} planned depth maps {are} not there: shares are of those that are, and other orders are not judged by cells",
            listed.len()
        ));
    }
    let beyond = run
        .clusters
        .iter()
        .filter(|cluster| !listed.contains(&cluster.key));
    let beyond: Vec<&str> = beyond
        .map(|cluster| plan.stages.scene.name(cluster.key))
        .collect();
    if let Some(first) = beyond.first() {
        let what = counted(beyond.len(), "depth map");
        warn(&format!(
            "{what} beyond the plan's list, the first of {first}: measured, but not in a cloud of the list"
        ));
    }
    if let Some(view) = evaluation.other_partners.first() {
        let what = counted(evaluation.other_partners.len(), "depth map");
        warn(&format!(
            "{what} made with other partners than planned, the first of {view}"
        ));
    }
    other_sizes_in_words(&plan.stages, &run.other_sizes)
        .iter()
        .for_each(|left_out| warn(left_out));
    run.unreadable
        .iter()
        .for_each(|why| warn(&format!("left out: {why}")));
    if let Some(file) = run.strangers.first() {
        let what = counted(run.strangers.len(), "depth map");
        warn(&format!(
            "{what} of no view of this model or export, the first is {}",
            file.display()
        ));
    }
}

fn text(e: &Evaluation, depth_maps: &Path, out: &Path) -> Vec<String> {
    let mut lines = vec![format!("Depth maps: {}", shown_path(depth_maps))];
    lines.extend(summary(e));
    lines.push(String::new());
    if e.inside < 1.0 {
        lines.extend(["Fulfilment and shares are those inside the region.", ""].map(String::from));
    }
    // Other orders begin with maps that are not there.
    if e.without_map.is_empty() {
        lines.extend(e.cells.lines());
        lines.push(String::new());
    }
    lines.extend(shares_of_cells(e));
    if !e.orders.is_empty() {
        lines.push(String::new());
        lines.extend(table_of_orders(e));
    }
    lines.push(String::new());
    lines.extend(missing(e));
    lines.push(String::new());
    lines.push(format!("See {}", shown_path(&out.join("evaluation.html"))));
    lines
}

fn summary(e: &Evaluation) -> Vec<String> {
    let truth = if e.reference {
        "against the reference"
    } else {
        "no reference: every depth counts as right"
    };
    let maps = match e.at_half_size() {
        0 => format!("{} depth maps", e.key_views.len()),
        half => format!(
            "{} depth maps, {half} of them at half the size",
            e.key_views.len()
        ),
    };
    let completeness = 100.0 * e.quality.completeness;
    let mut lines = vec![
        format!("{maps}, {truth}"),
        format!("  completeness {completeness:.1} %{}", e.errors()),
        format!("  reached: {}", e.reached_in_words()),
        format!("  {}", e.enough_in_words()),
    ];
    lines.extend(
        e.half_size
            .iter()
            .map(|half| format!("  {}", half.in_words())),
    );
    for at in e.clouds.iter().flat_map(|clouds| &clouds.within) {
        let (completeness, precision) = (100.0 * at.completeness, 100.0 * at.precision);
        lines.push(format!(
            "  fused cloud within {:.0} GSD of the reference: completeness {completeness:.1} %, precision {precision:.1} %",
            at.gsd
        ));
    }
    lines.push(format!(
        "  they give {:.1} % of what is wanted (fulfilment); {:.1} % was predicted",
        100.0 * e.real,
        100.0 * e.predicted
    ));
    lines
}

fn shares_of_cells(e: &Evaluation) -> Vec<String> {
    let mut lines = vec![
        format!(
            "share of the area of these {} maps that the first cover: predicted, and real",
            e.key_views.len()
        ),
        "predicted share   key views   pairs   real share   three maps agree".into(),
    ];
    for gap in e
        .gap
        .chunk_by(|one, next| one.clusters == next.clusters)
        // Of several shares that the same maps reach, the highest.
        .filter_map(<[_]>::last)
    {
        let [share, real, agreeing] = [gap.share, gap.real, gap.agreeing].map(|of| 100.0 * of);
        lines.push(format!(
            "{share:13.0} % {:11} {:7} {real:10.1} % {agreeing:16.1} %",
            gap.clusters, gap.pairs
        ));
    }
    lines
}

fn table_of_orders(e: &Evaluation) -> Vec<String> {
    let heading = "key views for a share of the fulfilment of each triangle, the paper's measure";
    let shares = e.orders[0].needed.iter();
    let mut lines = vec![
        heading.into(),
        shares
            .map(|n| format!("{:4.0} %", 100.0 * n.share))
            .collect(),
    ];
    for (names, cells) in baselines::rows(&e.orders, false) {
        let cells: String = cells.iter().map(|cell| format!("{cell:>6}")).collect();
        lines.push(format!("{cells}  {}", names.join(", ")));
    }
    lines
}

fn missing(e: &Evaluation) -> Vec<String> {
    let mut lines = vec![format!(
        "missing where less than half is fulfilled, of {} triangles",
        e.triangles
    )];
    for (missing, count) in &e.missing {
        lines.push(format!(
            "  {:6.1} % {}",
            100.0 * *count as f64 / e.triangles.max(1) as f64,
            missing.describe()
        ));
    }
    lines
}
