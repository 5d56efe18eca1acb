//! The trait of all errors of this crate.

/// Errors are interface: `Display` says what went wrong and where (file with byte or line, view, setting), its cause included;
/// `hint` says what to do about it. Only the program prints them, in one place.
pub trait Hint: std::error::Error {
    /// A sentence that starts with a verb, or `None` where there is nothing to advise.
    fn hint(&self) -> Option<String>;

    /// The file or folder that the error is about, if it is about one.
    fn path(&self) -> Option<&std::path::Path> {
        None
    }

    /// Returns whether an argument or a setting is wrong, so that nothing was tried.
    fn is_usage(&self) -> bool {
        false
    }
}
