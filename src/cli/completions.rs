//! `viewrank completions` and `viewrank man`: both come from the definitions that parse the command
//! line.

use clap::{Args, Command, CommandFactory};
use clap_complete::Shell;

use super::{Failure, terminal::print_data};
use crate::base::error::{Advice, Hint};

/// Print the completion script for a shell.
///
/// For bash: viewrank completions bash > ~/.local/share/bash-completion/completions/viewrank
#[derive(Args)]
pub struct Arguments {
    shell: Shell,
}

/// Print the manual page of the program or a subcommand.
///
/// To read it: viewrank man plan | man -l -
#[derive(Args)]
pub struct ManArguments {
    /// Subcommand [default: the program itself].
    subcommand: Option<String>,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let mut script = Vec::new();
    clap_complete::generate(
        arguments.shell,
        &mut super::Arguments::command(),
        "viewrank",
        &mut script,
    );
    print_data(&String::from_utf8_lossy(&script))
}

pub fn man(arguments: &ManArguments) -> Result<(), Failure> {
    let definition = definition(arguments.subcommand.as_deref())?;
    let title = definition
        .get_display_name()
        .unwrap_or("viewrank")
        .to_owned();
    let mut page = Vec::new();
    let rendered = clap_mangen::Man::new(definition)
        .title(title)
        .render(&mut page);
    rendered.expect("writing to memory does not fail");
    print_data(&String::from_utf8_lossy(&page))
}

/// Returns the definition of the program, or of a subcommand under its full name (`viewrank-plan`,
/// the name of its manual page).
fn definition(subcommand: Option<&str>) -> Result<Command, Failure> {
    let mut program = super::Arguments::command();
    // Only then do subcommands have their full names.
    program.build();
    let Some(name) = subcommand else {
        return Ok(program);
    };
    match program.find_subcommand(name) {
        Some(found) => Ok(found.clone()),
        None => Err(UnknownSubcommand(name.into()).into()),
    }
}

#[derive(Debug, thiserror::Error)]
#[error("there is no subcommand \"{0}\"")]
struct UnknownSubcommand(String);

impl Hint for UnknownSubcommand {
    fn hint(&self) -> Option<Advice> {
        Some("type viewrank --help for the list".into())
    }

    fn is_usage(&self) -> bool {
        true
    }
}
