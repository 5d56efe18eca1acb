//! What every error of this crate has beside its message.

/// Errors are interface: `Display` says what went wrong and where (file with byte or line, view, setting), its cause included;
/// `hint` says what to do about it. Only the program prints them, in one place.
pub trait Hint: std::error::Error {
    /// A sentence that starts with a verb, or `None` where there is nothing to advise.
    fn hint(&self) -> Option<String>;

    /// Is what was typed or set wrong, so that nothing was tried?
    fn is_usage(&self) -> bool {
        false
    }
}
