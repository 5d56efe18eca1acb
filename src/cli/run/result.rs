//! The summary at the end of `viewrank run`.

use std::path::{Path, PathBuf};

use serde::Serialize;

use super::work::Work;
use crate::{
    backends,
    base::shell::shown_path,
    cli::{summary::duration, wrapped},
    daemon::follow,
    io::paths::from_here,
    show::{files::report_path, share::area_of_all},
};

/// Said at the end of a run that leaves nothing of the plan.
const ALL_DONE: &str = "the list is done, with all that the plan has";

/// JSON output: state at the end.
#[derive(Serialize)]
pub struct RunSummary {
    project: PathBuf,
    backend: &'static str,
    /// Numbers of finished and planned depth maps.
    done: usize,
    tasks: usize,
    failed: usize,
    /// Depth maps that the project could have.
    all: usize,
    /// All of them that can be made are there.
    is_whole: bool,
    /// Share of the area that all of them would cover, 0 to 1, estimated from the finished maps;
    /// null before the first measurement.
    share: Option<f64>,
    /// The same as the plan predicted it for as many maps; null if it was made around finished
    /// ones.
    predicted: Option<f64>,
    /// Seconds that this run matched for, and that all depth maps would take at that speed; null
    /// if it computed none.
    seconds: Option<[f64; 2]>,
    #[serde(skip)]
    has_region: bool,
    /// Target of the share; null if only other limits were set.
    target: Option<f64>,
    target_reached: bool,
    /// Stopped before its end.
    stopped: bool,
    /// Point cloud; null if none was made.
    cloud: Option<PathBuf>,
    /// Report page; null if none was written.
    report: Option<PathBuf>,
}

/// Why no more depth maps are computed.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Ended {
    TargetReached,
    ListDone,
    /// By Ctrl-C.
    Stopped,
}

/// Suggests a higher target after the whole list reached only `share` (measured): raised by the
/// shortfall, at least by five points. `None` if the list has all maps.
fn higher(target: f64, share: Option<f64>) -> Option<String> {
    let missing = share.map_or(0.0, |share| target - share);
    (target < 1.0).then(|| format!("{:.0}%", (100.0 * (target + missing.max(0.05))).min(100.0)))
}

impl Work<'_> {
    pub fn result(&self, ended: Ended) -> RunSummary {
        let report = report_path(self.foreground.root());
        let (done, all) = (self.dispatch.finished_maps().count(), self.plan.all_maps);
        let progress = follow::Progress::read(self.foreground.root());
        RunSummary {
            project: self.foreground.root().into(),
            backend: self.backend.name,
            done,
            all,
            is_whole: done == self.plan.clusters.len(),
            tasks: self.dispatch.tasks.len(),
            failed: self.failed.len(),
            share: progress.as_ref().and_then(|progress| progress.share),
            predicted: done
                .checked_sub(1)
                .filter(|_| self.plan.finished == 0)
                .and_then(|last| Some(self.plan.clusters.get(last)?.share)),
            seconds: self.seconds(
                done,
                progress.and_then(|progress| progress.seconds_per_pair),
            ),
            has_region: self.plan.settings.region.is_some(),
            target: self.target(),
            target_reached: ended == Ended::TargetReached,
            stopped: ended == Ended::Stopped,
            cloud: self.clouds().next().map(Path::to_path_buf),
            report: report.is_file().then_some(report),
        }
    }

    /// Time of matching the first maps of the list, and all maps: by the times of all finished maps
    /// where these are known, for earlier runs made some of them, else by this run's.
    fn seconds(&self, done: usize, per_pair: Option<f64>) -> Option<[f64; 2]> {
        let pairs = |maps: usize| {
            let clusters = self.plan.clusters.iter().take(maps);
            clusters
                .map(|cluster| cluster.partners.len())
                .sum::<usize>() as f64
        };
        let (computed, took) = self.computed;
        let of_run = || (computed > 0).then(|| took.as_secs_f64() / f64::from(computed));
        let in_all = self.plan.clusters.len();
        match per_pair {
            Some(each) => Some([done, in_all].map(|maps| each * pairs(maps))),
            None => of_run().map(|each| [done, in_all].map(|maps| each * maps as f64)),
        }
    }

    fn clouds(&self) -> impl Iterator<Item = &Path> {
        self.dispatch.runner().clouds_there()
    }

    pub fn describe(&self, result: &RunSummary) -> Vec<String> {
        let (verdict, next) = self.verdict(result);
        let mut lines = vec![String::new()];
        lines.extend(wrapped("", &format!("{}; {verdict}.", result.in_words())));
        let caution = backends::caution(result.backend).filter(|_| !result.is_whole);
        lines.extend(caution.into_iter().flat_map(|caution| wrapped("", caution)));
        // On a line of its own, to be copied.
        lines.extend(next);
        for cloud in self.clouds() {
            lines.push(format!("Point cloud: {}", shown_path(&from_here(cloud))));
        }
        if let Some(report) = &result.report {
            lines.push(format!("Report: {}", shown_path(&from_here(report))));
        }
        lines
    }

    /// Why the run ended, and the command to type next, if there is more to be had.
    fn verdict(&self, result: &RunSummary) -> (String, Option<String>) {
        if let Some(target) = result.target.filter(|_| result.target_reached) {
            let target = target_in_percent(target);
            return (format!("the target of {target} is reached"), None);
        }
        if result.stopped {
            return ("stopped".into(), Some(self.arguments.go_on()));
        }
        if result.failed > 0 {
            let again = format!("to try again: {}", self.again());
            return (format!("{} failed", result.failed), Some(again));
        }
        if result.tasks == self.plan.clusters.len() {
            return (ALL_DONE.into(), None);
        }
        match self.target().filter(|_| self.arguments.budget.is_none()) {
            None => ("the budget is spent; raise --budget for more".into(), None),
            Some(target) => match higher(target, result.share) {
                None => (ALL_DONE.into(), None),
                Some(higher) => {
                    let more = format!("for more: {}", self.arguments.again(Some(&higher)));
                    ("the target was not reached".into(), Some(more))
                }
            },
        }
    }
}

/// Formats a target as "59.5 %".
pub fn target_in_percent(target: f64) -> String {
    format!("{} %", (1000.0 * target).round() / 10.0)
}

impl RunSummary {
    /// Says what was computed, what that gives of what, how that is known, and what it saved.
    fn in_words(&self) -> String {
        let Self { done, all, .. } = *self;
        let area = area_of_all(Some(all), self.has_region);
        let percent = |share: f64| format!("{:.0} %", 100.0 * share);
        let share = match (self.share, self.predicted) {
            _ if self.is_whole => "the whole area".to_owned(),
            (Some(share), predicted) => {
                let said = predicted.map_or_else(String::new, |predicted| {
                    format!("; the plan said {}", percent(predicted))
                });
                let about = percent(share);
                format!("about {about} of {area} (estimated from these maps{said})")
            }
            _ => format!("their share of {area} is not known"),
        };
        let seconds = self
            .seconds
            // Exports that were written anew have forgotten the times.
            .filter(|[here, _]| !self.is_whole && *here >= 0.5)
            .map_or_else(String::new, |[here, whole]| {
                let [here, whole] = [here, whole].map(duration);
                format!(", in {here} of matching, where all would take about {whole}")
            });
        format!("{done} of {all} depth maps: {share}{seconds}")
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn a_list_that_fell_short_asks_for_a_higher_target() {
        let cases = [
            ((0.7, Some(0.695)), Some("75%")),
            ((0.8, None), Some("85%")),
            ((0.7, Some(0.6)), Some("80%")),
            ((0.98, Some(0.97)), Some("100%")),
            ((1.0, Some(0.9)), None),
        ];
        for ((target, share), expected) in cases {
            assert_eq!(
                super::higher(target, share).as_deref(),
                expected,
                "{target} {share:?}"
            );
        }
    }
}
