//! `viewrank-bench`: matching partners by other authors' rules beside viewrank's, for the same key
//! views (`docs/method.md` 8).

mod compare;
mod rules;

use std::{error::Error, path::PathBuf, process::ExitCode};

use clap::Parser;
use viewrank::{
    NoWatcher,
    output::{Disk, FileSet},
    replan::as_written,
};

/// Compare viewrank's matching partners with those of other authors' rules.
#[derive(Parser)]
#[command(version)]
enum Command {
    /// Write the view clusters of each rule to DIR/kK/RULE/clusters.txt, to be matched there
    Partners {
        /// Folder of a project with a plan (viewrank plan)
        project: PathBuf,
        #[arg(value_name = "DIR")]
        out: PathBuf,
        /// Partners per key view
        #[arg(short, value_name = "K,...", value_delimiter = ',', default_values_t = [2, 3, 5, 11])]
        k: Vec<u32>,
    },
    /// Compare the folders in DIR that hold a clusters.txt and its depth maps
    Compare {
        /// Folder of the project
        project: PathBuf,
        #[arg(value_name = "DIR")]
        folder: PathBuf,
        /// Folder of reference depth maps [default: every depth counts as right]
        #[arg(long, value_name = "DIR")]
        reference: Option<PathBuf>,
        /// Print the results as JSON
        #[arg(long)]
        json: bool,
    },
}

fn main() -> ExitCode {
    match run(Command::parse()) {
        Ok(text) => {
            print!("{text}");
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

/// Returns what is printed.
fn run(command: Command) -> Result<String, Box<dyn Error>> {
    match command {
        Command::Partners { project, out, k } => {
            let (_, plan, _) = as_written(&project, &NoWatcher)?;
            let mut files = FileSet::new(&out, "baselines");
            for k in k {
                for choice in compare::choices(&plan, k)? {
                    let name = format!("k{k}/{}/clusters.txt", choice.rule);
                    files.add_text(name, choice.text(&plan));
                }
            }
            files.write(&Disk::REAL)?;
            Ok(String::new())
        }
        Command::Compare {
            project,
            folder,
            reference,
            json,
        } => {
            let (_, plan, _) = as_written(&project, &NoWatcher)?;
            let compared = compare::in_folders(&plan, &folder, reference.as_deref())?;
            if json {
                Ok(serde_json::to_string(&compared)? + "\n")
            } else {
                Ok(compare::table(&compared))
            }
        }
    }
}
