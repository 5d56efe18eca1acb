//! The `viewrank` binary; everything is in `viewrank::cli`.

fn main() -> std::process::ExitCode {
    viewrank::cli::main()
}
