//! Plans one project and measures its depth maps as the daemon does, in the foreground: for
//! `viewrank run`.

use std::{
    path::{Path, PathBuf},
    sync::atomic::AtomicBool,
};

use super::{
    Job, PlanJob, PlanOptions, PlanWhen, Planner,
    follow::failed,
    maps::map_files_inside,
    settle::Stamp,
    state::{OnBusy, Outcome},
};
use crate::config::CommandLineSettings;

/// Memory for the plan between two measurements, bytes.
const CACHE: u64 = 4 << 30;

/// A project under work.
pub struct Foreground<'a> {
    root: PathBuf,
    planner: PlanJob,
    stop: &'a AtomicBool,
}

impl<'a> Foreground<'a> {
    /// `typed`: settings of the command line; `stop` cancels what runs.
    pub fn new(root: &Path, typed: CommandLineSettings, stop: &'a AtomicBool) -> Self {
        let options = PlanOptions {
            on_target: None,
            replan: false,
            cache: CACHE,
            // The user has named this project; `map_files_inside` leaves maps outside of it alone.
            follow_links: true,
            roots: Vec::new(),
            typed,
            is_run: true,
        };
        let root = dunce::canonicalize(root).unwrap_or_else(|_| root.into());
        Self {
            root,
            planner: PlanJob::new(options),
            stop,
        }
    }

    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Plans the project, around the depth maps of its plan, if there are any.
    pub fn plan(&self, when: PlanWhen, progress: &(dyn Fn(&str, u8) + Sync)) -> Outcome {
        let plan = |planner: &PlanJob, job: &Job| planner.plan_if(when, job);
        self.job(progress, &|_| true, plan)
    }

    /// Measures those of the present depth maps that count, and writes `progress.json`.
    pub fn measure(&self, counts: &dyn Fn(&Path) -> bool) -> Outcome {
        self.job(&|_, _| {}, counts, PlanJob::follow)
    }

    fn job(
        &self,
        progress: &(dyn Fn(&str, u8) + Sync),
        counts: &dyn Fn(&Path) -> bool,
        work: impl FnOnce(&PlanJob, &Job) -> Outcome,
    ) -> Outcome {
        let named = self.planner.named_files(&self.root);
        let stamp = Stamp::read(&self.root, true).with(&named);
        let mut maps = match map_files_inside(&self.root) {
            Ok(maps) => maps,
            Err(error) => return failed(error),
        };
        maps.retain(|path, _| counts(path));
        let job = Job {
            project: &self.root,
            stamp: &stamp,
            named: &named,
            on_busy: OnBusy::Restart,
            follow_links: true,
            maps: &maps,
            most_memory: None,
            cancel: self.stop,
            progress,
        };
        work(&self.planner, &job)
    }
}
