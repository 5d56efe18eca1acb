//! The `viewrank` binary; everything is in `viewrank::cli`.

#[cfg(target_env = "musl")]
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> std::process::ExitCode {
    viewrank::cli::main()
}
