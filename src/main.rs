//! The program; see `cli`.

fn main() -> std::process::ExitCode {
    viewrank::cli::main()
}
