//! The command that `viewrank plan` names last.

use std::path::Path;

use super::arguments::typed_words;
use crate::{
    backends::{self, CUT_PANORAMAS},
    base::shell::{command_path, command_word, one_after_other},
    io::project::Project,
    plan::Plan,
    show::files::PlanFiles,
};

/// Appends the options that have a value to a command.
pub fn with_options<const N: usize>(start: String, options: [(&str, Option<String>); N]) -> String {
    let typed = options
        .into_iter()
        .filter_map(|(name, value)| Some(format!(" {name} {}", command_word(&value?))));
    typed.fold(start, |command, option| command + &option)
}

/// Returns the value of `--scales`, as it was typed.
pub fn scales(scales: Option<&[f64]>) -> Option<String> {
    scales.map(|scales| {
        scales
            .iter()
            .map(f64::to_string)
            .collect::<Vec<_>>()
            .join(",")
    })
}

/// Returns the same command without `--dry-run`.
pub fn not_dry() -> String {
    let typed = typed_words()
        .into_iter()
        .skip(1)
        .filter(|argument| argument != "--dry-run");
    typed.fold("viewrank".into(), |command, argument| {
        command + " " + &command_word(&argument)
    })
}

/// Returns the typed command for another project, which is quoted already. `typed`: the project as
/// it was typed; `backend`: that of the plan, if none was typed.
pub fn for_other_project(typed: &Path, project: &str, backend: &str) -> String {
    let typed = typed.to_string_lossy();
    let (mut command, mut is_replaced, mut has_backend) = ("viewrank".to_owned(), false, false);
    for word in typed_words().into_iter().skip(1) {
        has_backend |= word == "--backend" || word.starts_with("--backend=");
        // Only the first: an option may have the same word as its value.
        if !is_replaced && word == typed {
            is_replaced = true;
            command += &format!(" {project}");
        } else {
            command += &format!(" {}", command_word(&word));
        }
    }
    if !has_backend {
        command += &format!(" --backend {backend}");
    }
    command
}

/// Returns what makes depth maps of a plan: `run` where this machine can match, else the first
/// command of a backend whose files were written, or the command that writes such files. `run`: the
/// command of `viewrank run` that makes the same plan. `again`: the command that plans another
/// project, whose path is given quoted, in the same way.
pub fn next(
    project: &Project,
    plan: &Plan,
    files: &PlanFiles,
    run: Option<String>,
    again: &dyn Fn(&str) -> String,
) -> String {
    let root = project.as_argument();
    let backend = backends::by_name(plan.stages.backend).ok();
    let of_unread_kind = backends::of_unread_kind(project, &plan.stages.scene, plan.stages.backend);
    let has_images = project.images.is_some()
        && of_unread_kind.is_none()
        && plan
            .stages
            .image_faults
            .is_any_usable(plan.stages.scene.views.len());
    // Called last, since it starts programs to ask them what they can do.
    let can_match = || cfg!(unix) && has_images && backend.is_some_and(backends::can_match_here);
    let distorted = || {
        plan.stages
            .scene
            .view_indices()
            .any(|view| !plan.stages.scene.camera_of(view).is_pinhole())
    };
    match (run.filter(|_| can_match()), &files.next) {
        (Some(run), _) => run,
        (None, Some(next)) => next.clone(),
        (None, None) if !has_images => {
            let (scene, faults) = (&plan.stages.scene, &plan.stages.image_faults);
            let cure = backends::cure_of_images(project, scene, plan.stages.backend, faults);
            format!("{cure}, then {}", again(&root))
        }
        (None, None) if !backend.is_some_and(|backend| backend.takes_distorted) && distorted() => {
            let plan_of = |dense: &Path| again(&command_path(dense));
            match project.undistorted_workspace() {
                Some(dense) => plan_of(&dense),
                None if backends::has_panoramas(&plan.stages.scene) => {
                    format!("{CUT_PANORAMAS}, then {}", again(&root))
                }
                None => one_after_other(
                    &format!("viewrank undistort {root}"),
                    &plan_of(&project.place_of_undistorted()),
                ),
            }
        }
        (None, None) => format!(
            "viewrank export {} --backend {}",
            command_path(&project.home),
            files.manifest.backend
        ),
    }
}
