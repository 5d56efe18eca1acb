//! `viewrank report`: page of a plan, with the gaps and their reasons.

use std::{
    path::{Path, PathBuf},
    process::Stdio,
};

use crate::base::error::{Advice, Hint};
use crate::{
    apps::{
        replan,
        report::{self, Contents, DepthMapFolders},
    },
    backends::ExportRecord,
    base::{
        platform,
        progress::{Stage, Watcher},
        shell::{command_path, shown_path},
    },
    io::{
        output::{self, Disk, FileSet},
        project::Project,
    },
    plan::Plan,
    show::files::{REPORT_FILE, REPORT_SET, report_path},
};
use clap::Args;

use super::{Failure, Format, print, print_json, progress::ProgressDisplay, use_threads, warn};

/// Write a page about a plan to PROJECT/viewrank/report.html, for any browser.
///
/// Shows a map, the curve, the ranked views with their reasons, and the gaps, for any cut. A flight
/// plan of images that would fill the gaps is written to PROJECT/viewrank/flight. The page needs no
/// network. Run viewrank plan first; a new plan marks the old page as stale. Tables that
/// viewrank/cache does not hold are computed again and kept there (not with --out); viewrank plan
/// --report writes the page together with the plan.
#[derive(Args)]
pub struct Arguments {
    /// Folder of the project, or its model
    #[arg(value_parser = super::arguments::project())]
    project: PathBuf,

    /// Open the page in the browser
    #[arg(long)]
    open: bool,
    /// Finished depth maps to compare with the prediction [default: where the backends write
    /// theirs]
    #[arg(long, value_name = "DIR", value_parser = super::arguments::folder())]
    depth_maps: Option<PathBuf>,
    /// Exact or better depth maps to use as reference
    #[arg(long, value_name = "DIR", value_parser = super::arguments::folder())]
    reference: Option<PathBuf>,
    /// Folder for the page [default: PROJECT/viewrank]
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

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    use_threads(arguments.threads);
    let progress = ProgressDisplay::new(arguments.quiet || arguments.format == Format::Json);
    let folders = DepthMapFolders {
        depth_maps: arguments.depth_maps.clone(),
        reference: arguments.reference.clone(),
    };
    let page = write_to(
        &arguments.project,
        arguments.out.as_deref(),
        &folders,
        &progress,
    )?;
    progress.finish();
    let page = page.after_warning();
    if arguments.open {
        open(&page)?;
    }
    match arguments.format {
        Format::Json => print_json(&serde_json::json!({ "report": page })),
        Format::Text if arguments.quiet => Ok(()),
        Format::Text => print([shown_path(&page)]),
    }
}

/// A report page on the disk.
pub struct WrittenPage {
    path: PathBuf,
    warnings: Vec<String>,
}

impl WrittenPage {
    /// Prints the warnings, and returns the path.
    pub fn after_warning(self) -> PathBuf {
        self.warnings.iter().for_each(|warning| warn(warning));
        self.path
    }
}

/// Writes the page of a project's plan into the project.
pub fn write(project: &Path, progress: &ProgressDisplay) -> Result<WrittenPage, Failure> {
    write_to(project, None, &DepthMapFolders::default(), progress)
}

/// Like [`write`], into the folder `out` if given.
fn write_to(
    project: &Path,
    out: Option<&Path>,
    folders: &DepthMapFolders,
    progress: &ProgressDisplay,
) -> Result<WrittenPage, Failure> {
    let folder = out.map_or_else(|| project.join("viewrank"), Path::to_path_buf);
    // Without that folder there is no plan, which is another error.
    if out.is_some() || folder.is_dir() {
        output::refuse_unwritable(&folder).map_err(|error| {
            super::plan::elsewhere(error, out.is_some(), "report", &command_path(project))
        })?;
    }
    let (project, plan, exports) = replan::as_written(project, progress)?;
    let page = write_page(&project, &plan, &exports, out, folders, progress)?;
    // Under a memory limit, cached tables are valid for one number of threads only: leave those of
    // the plan.
    if out.is_none() && plan.stages.settings.max_memory.is_none() {
        keep(&plan);
    }
    Ok(page)
}

/// Keeps the results of stages that the page had to compute again, as a plan does.
fn keep(plan: &Plan) {
    let why = match output::write_all(&plan.unwritten(), &Disk::REAL) {
        Ok(sets) => sets.into_iter().find_map(|set| set.failed),
        Err(error) => Some(error.to_string()),
    };
    if let Some(why) = why {
        warn(&format!(
            "the tables computed for the page are not kept: {why}"
        ));
    }
}

/// Writes the page of a plan that is in memory, with the warnings of its exports, into the project
/// or the folder `out`.
pub fn write_page(
    project: &Project,
    plan: &Plan,
    exports: &[ExportRecord],
    out: Option<&Path>,
    folders: &DepthMapFolders,
    progress: &ProgressDisplay,
) -> Result<WrittenPage, Failure> {
    let (root, name) = match out {
        Some(folder) => (folder, "report.html"),
        None => (&*project.home, REPORT_FILE),
    };
    let contents = Contents::new(plan, project, exports, folders, progress)?;
    progress.progress(Stage::Write, 0, 1);
    let mut files = FileSet::new(root, REPORT_SET);
    files.add_text(name, report::page(&contents));
    let folder = name.strip_suffix("report.html").unwrap_or_default();
    for (file, text) in &contents.flight_files {
        files.add_text(format!("{folder}{file}"), text.clone());
    }
    files.write(&project.disk())?;
    progress.progress(Stage::Write, 1, 1);
    let path = if out.is_some() {
        root.join(name)
    } else {
        report_path(root)
    };
    let warnings = contents.cautions;
    Ok(WrittenPage { path, warnings })
}

/// Opens the page in the desktop's default program.
fn open(page: &Path) -> Result<(), OpenFailure> {
    let opener = match std::env::consts::OS {
        "macos" => "open",
        "windows" => "explorer",
        _ => "xdg-open",
    };
    let started = platform::command(opener).and_then(|mut command| {
        command
            .arg(page)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
    });
    started.map(|_| ()).map_err(|source| OpenFailure {
        page: page.into(),
        opener,
        source,
    })
}

#[derive(Debug, thiserror::Error)]
#[error("{} is written, but {opener} does not start: {source}", page.display())]
struct OpenFailure {
    page: PathBuf,
    opener: &'static str,
    source: std::io::Error,
}

impl Hint for OpenFailure {
    fn hint(&self) -> Option<Advice> {
        Some("open that file in a browser".into())
    }
}
