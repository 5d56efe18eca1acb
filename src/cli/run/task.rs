//! `viewrank run --rank` and `--fuse`: one task of a plan, as a process of a queue.

use std::{path::Path, sync::atomic::AtomicBool};

use super::Arguments;
use crate::{
    apps::dispatch::{
        Dispatch, Tools,
        runner::{Owner, Runner, TaskResult},
        slurm,
    },
    backends::{self, Product},
    cli::{Exit, Failure, note, warn},
    daemon::follow,
    show::manifest::WrittenPlan,
};

/// Does a task of the project's plan; ends at once where its result is there, or the depth maps
/// reach the target. So a queue may start it any number of times.
pub fn run(arguments: &Arguments, product: Product, stop: &AtomicBool) -> Result<(), Failure> {
    // As dispatch names the project.
    let root =
        dunce::canonicalize(&arguments.project).unwrap_or_else(|_| arguments.project.clone());
    let plan = WrittenPlan::read(&root)?;
    let backend = backends::by_name(arguments.backend.as_ref().unwrap_or(&plan.backend))?;
    let cut = plan.cut_at(arguments.budget, None);
    let (dispatch, export) = Dispatch::of_plan(&plan, backend, cut)?;
    let root = &plan.project.root;
    let say = |text: &str| {
        if !arguments.is_silent() {
            note(text);
        }
    };
    dispatch.refuse_strangers()?;
    // The fusion is wanted at the target, too.
    if matches!(product, Product::Map(_)) && ends_at_target(root, &dispatch, say) {
        return Ok(());
    }
    dispatch.refuse_other_export(&export)?;
    let tools = Tools::find(&dispatch, arguments.program.as_deref())?;
    let runner = Runner {
        tools: &tools,
        threads: arguments.threads(),
        stop,
        owner: Owner::Queue,
        on_wait: &|| say("waiting for another process that does the same"),
    };
    match product {
        Product::Map(rank) => {
            let Some(task) = dispatch.tasks.iter().find(|task| task.rank == rank) else {
                return no_task(rank, cut, say);
            };
            let what = format!("rank {rank}: {}", task.key);
            say(&what);
            report(dispatch.compute(task, &runner)?, &what, say)?;
            ends_at_target(root, &dispatch, say);
        }
        Product::Cloud => {
            let done = dispatch.finished_maps().count();
            let all = dispatch.tasks.len();
            say(&format!("{done} of {all} depth maps are there"));
            report(dispatch.fuse(&runner)?, "the fusion", say)?;
        }
    }
    Ok(())
}

/// Says how a task ended.
fn report(ended: TaskResult, what: &str, say: impl Fn(&str)) -> Result<(), Failure> {
    match ended {
        TaskResult::Done => say(&format!("{what}: done")),
        TaskResult::Idle => say(&format!("{what}: nothing to do")),
        TaskResult::Stopped => {
            return Err(Failure::new(Exit::Failed, format!("{what}: stopped"), None));
        }
        TaskResult::Failed(output) => {
            let failed = Failure::new(Exit::Failed, format!("{what} failed"), None);
            return Err(failed.with_output(&output));
        }
    }
    Ok(())
}

/// Says that no depth map can be made of the cluster of a rank.
///
/// # Errors
/// If the plan's list is shorter.
fn no_task(rank: usize, cut: usize, say: impl Fn(&str)) -> Result<(), Failure> {
    if rank > cut {
        let message = format!("rank {rank}: the list ends at rank {cut}");
        return Err(Failure::new(Exit::Usage, message, None));
    }
    say(&format!("rank {rank}: no depth map can be made of it"));
    Ok(())
}

/// Returns whether the finished depth maps reach the target; the tasks that wait behind this one
/// are not needed then.
fn ends_at_target(root: &Path, dispatch: &Dispatch, say: impl Fn(&str)) -> bool {
    let Some(progress) = follow::reached(root) else {
        return false;
    };
    if !dispatch.has_maps_of(&progress.finished) {
        warn(&format!(
            "{} says that the target is reached, but not all depth maps that it counts are there: it is ignored",
            follow::progress_file(root).display()
        ));
        return false;
    }
    say("the target is reached");
    if let Err(error) = slurm::cancel_rest_of_array() {
        warn(&error.to_string());
    }
    true
}
