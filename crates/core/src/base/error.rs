//! The trait of all errors of this crate.

/// Errors are interface: `Display` says what went wrong and where (file with byte or line, view,
/// setting), its cause included; `hint` says what to do about it. Only the program prints them, in
/// one place.
pub trait Hint: std::error::Error {
    /// Returns advice, an imperative; `None` if there is none.
    fn hint(&self) -> Option<String>;

    /// Returns the file or folder that the error concerns, if any.
    fn path(&self) -> Option<&std::path::Path> {
        None
    }

    /// Returns whether an argument or a setting is wrong (exit code 2).
    fn is_usage(&self) -> bool {
        false
    }
}
