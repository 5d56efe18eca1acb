//! Progress for people, on stderr: a bar with the time left on a terminal, a line per stage
//! elsewhere.

use std::{
    sync::{Mutex, PoisonError},
    time::Instant,
};

use crate::base::progress::{Stage, Watcher};
use indicatif::{ProgressBar, ProgressStyle};

use super::terminal::{complain, is_stderr_terminal};

pub struct ProgressDisplay {
    kind: Kind,
    running: Mutex<Option<RunningStage>>,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    None,
    Lines,
    Bars,
}

/// The stage under way.
struct RunningStage {
    stage: Stage,
    since: Instant,
    bar: ProgressBar,
}

impl ProgressDisplay {
    pub fn new(quiet: bool) -> Self {
        let kind = match (quiet, is_stderr_terminal()) {
            (true, _) => Kind::None,
            (false, true) => Kind::Bars,
            (false, false) => Kind::Lines,
        };
        Self {
            kind,
            running: Mutex::new(None),
        }
    }

    /// Ends the last stage.
    pub fn finish(&self) {
        if let Some(running) = self
            .running
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .take()
        {
            self.end(&running);
        }
    }

    fn start(&self, stage: Stage) -> RunningStage {
        let bar = if self.kind == Kind::Bars {
            bar(stage)
        } else {
            ProgressBar::hidden()
        };
        RunningStage {
            stage,
            since: Instant::now(),
            bar,
        }
    }

    fn end(&self, running: &RunningStage) {
        running.bar.finish_and_clear();
        if self.kind == Kind::Lines {
            complain(&format!(
                "{}: {:.1} s",
                describe(running.stage),
                running.since.elapsed().as_secs_f64()
            ));
        }
    }
}

impl Watcher for ProgressDisplay {
    fn progress(&self, stage: Stage, done: u64, total: u64) {
        if self.kind == Kind::None {
            return;
        }
        let mut running = self.running.lock().unwrap_or_else(PoisonError::into_inner);
        if running
            .as_ref()
            .is_none_or(|running| running.stage != stage)
        {
            running.take().iter().for_each(|earlier| self.end(earlier));
        }
        let bar = &running.get_or_insert_with(|| self.start(stage)).bar;
        bar.set_length(total);
        bar.set_position(done);
    }
}

fn bar(stage: Stage) -> ProgressBar {
    let style = ProgressStyle::with_template("{msg:32} {bar:24} {percent:>3} %  {eta} left");
    let bar =
        ProgressBar::new(1).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
    bar.set_message(describe(stage));
    bar
}

/// Describes a stage for the progress display.
fn describe(stage: Stage) -> &'static str {
    match stage {
        Stage::Read => "reading the model",
        Stage::Surface => "building the surface",
        Stage::Visibility => "computing visibility",
        Stage::Confidence => "reading the images",
        Stage::Partners => "choosing matching partners",
        Stage::Pilot => "matching thumbnails",
        Stage::Ranking => "ranking view clusters",
        Stage::Evaluate => "measuring depth maps",
        Stage::Undistort => "undistorting images",
        Stage::Train => "reading depth maps",
        Stage::Write => "writing",
    }
}
