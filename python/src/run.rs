//! Long calls: the library runs in a thread of its own without the interpreter's lock, while the
//! calling thread passes progress on and listens for Ctrl-C.

use std::{
    panic::resume_unwind,
    sync::{
        Condvar, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

use pyo3::{exceptions::PyRuntimeError, prelude::*};
use viewrank::{Stage, Watcher};

use crate::failure::Failure;

/// Longest time between two looks for Ctrl-C.
const LOOK: Duration = Duration::from_millis(50);

/// How to run a long call.
#[derive(FromPyObject)]
pub struct Runner {
    /// Called with stage, steps done and steps in total, in the calling thread; an exception
    /// cancels the call.
    #[pyo3(attribute("progress"))]
    progress: Option<Py<PyAny>>,
    /// Number of threads; `None`: one per core.
    #[pyo3(attribute("threads"))]
    threads: Option<usize>,
}

/// Progress that is not passed on yet, and whether to stop.
#[derive(Default)]
struct Shared {
    news: Mutex<News>,
    changed: Condvar,
    cancelled: AtomicBool,
}

#[derive(Default)]
struct News {
    /// The last state of each stage since the callback was last called, in the order of the stages.
    stages: Vec<(Stage, u64, u64)>,
    is_done: bool,
}

impl Shared {
    fn news(&self) -> MutexGuard<'_, News> {
        self.news.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until the call is done or it is time to look for Ctrl-C; returns the news.
    fn wait(&self) -> (Vec<(Stage, u64, u64)>, bool) {
        let waited = self
            .changed
            .wait_timeout_while(self.news(), LOOK, |news| !news.is_done);
        let mut news = waited.map_or_else(|poisoned| poisoned.into_inner().0, |(news, _)| news);
        (std::mem::take(&mut news.stages), news.is_done)
    }
}

impl Watcher for Shared {
    fn progress(&self, stage: Stage, done: u64, total: u64) {
        let mut news = self.news();
        match news.stages.last_mut() {
            // Several threads report one stage, not always in order.
            Some(last) if last.0 == stage && last.2 == total => last.1 = last.1.max(done),
            _ => news.stages.push((stage, done, total)),
        }
    }

    fn cancelled(&self) -> bool {
        self.cancelled.load(Ordering::Relaxed)
    }
}

/// Tells the calling thread that the call is done, even if it panics.
struct Done<'a>(&'a Shared);

impl Drop for Done<'_> {
    fn drop(&mut self) {
        self.0.news().is_done = true;
        self.0.changed.notify_all();
    }
}

impl Runner {
    /// Runs `work` and returns its result; raises what the progress callback or Ctrl-C raises,
    /// after `work` has stopped.
    pub fn run<T: Send>(
        &self,
        py: Python<'_>,
        work: impl FnOnce(&dyn Watcher) -> Result<T, Failure> + Send,
    ) -> PyResult<T> {
        // A pool of its own: the global one can be made only once in a process.
        let pool = match self.threads {
            Some(threads) => Some(
                rayon::ThreadPoolBuilder::new()
                    .num_threads(threads)
                    .build()
                    .map_err(|error| {
                        PyRuntimeError::new_err(format!("cannot start {threads} threads: {error}"))
                    })?,
            ),
            None => None,
        };
        let shared = &Shared::default();
        thread::scope(|scope| {
            let worker = scope.spawn(move || {
                let _done = Done(shared);
                match pool {
                    Some(pool) => pool.install(|| work(shared)),
                    None => work(shared),
                }
            });
            let raised = self.follow(py, shared);
            let result = py
                .detach(|| worker.join())
                .unwrap_or_else(|panic| resume_unwind(panic));
            // What was raised is the cause; the result says no more than that it was cancelled.
            raised?;
            Ok(result?)
        })
    }

    /// Passes progress on until the call is done.
    fn follow(&self, py: Python<'_>, shared: &Shared) -> PyResult<()> {
        let mut raised = Ok(());
        loop {
            let (stages, is_done) = py.detach(|| shared.wait());
            if raised.is_ok() {
                // In this order: a callback may be what is interrupted, also after the last stage.
                raised = self.report(py, &stages).and_then(|()| py.check_signals());
                shared.cancelled.store(raised.is_err(), Ordering::Relaxed);
            }
            if is_done {
                return raised;
            }
        }
    }

    fn report(&self, py: Python<'_>, stages: &[(Stage, u64, u64)]) -> PyResult<()> {
        let Some(progress) = &self.progress else {
            return Ok(());
        };
        stages.iter().try_for_each(|&(stage, done, total)| {
            let name = format!("{stage:?}").to_lowercase();
            progress.call1(py, (name, done, total)).map(drop)
        })
    }
}
