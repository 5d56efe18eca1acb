//! Photographs of the views and their masks, wherever they come from.

use super::{Grey, Mask};
use crate::model::scene::{Scene, ViewIndex};

/// Consequence of a damaged picture or one with the wrong aspect ratio, if other pictures can be
/// compared.
pub const NOT_PLANNED: &str = "the image is neither matched nor planned";
/// Consequence of any other unusable picture or mask with photometric confidence.
pub const NOT_COMPARED: &str = "the image is not compared";
/// Consequence of an unusable mask with geometric confidence.
pub const ALL_COUNTS: &str = "all of the image counts";
/// Number of images named in a warning.
const NAMED: usize = 3;

/// Photographs and masks of the views of a scene.
pub trait Pictures: Sync {
    /// Returns whether there are photographs at all.
    fn have_images(&self) -> bool;

    /// Returns the view's picture in grey at half the size at which it is matched, and its mask;
    /// `None` without photographs.
    fn grey(
        &self,
        scene: &Scene,
        view: ViewIndex,
        image_scale: f64,
    ) -> Result<Option<(Grey, Option<Mask>)>, PictureError>;

    /// Returns the view's mask; `None` if it has none.
    fn mask(&self, scene: &Scene, view: ViewIndex) -> Result<Option<Mask>, PictureError>;
}

/// A project without photographs.
pub struct NoPictures;

impl Pictures for NoPictures {
    fn have_images(&self) -> bool {
        false
    }

    fn grey(
        &self,
        _: &Scene,
        _: ViewIndex,
        _: f64,
    ) -> Result<Option<(Grey, Option<Mask>)>, PictureError> {
        Ok(None)
    }

    fn mask(&self, _: &Scene, _: ViewIndex) -> Result<Option<Mask>, PictureError> {
        Ok(None)
    }
}

/// A picture or mask that cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{cause}")]
pub struct PictureError {
    pub cause: Box<dyn std::error::Error + Send + Sync>,
    /// True if no program can match the image: it is damaged, or its aspect ratio differs from its
    /// camera's. False for formats that other programs may read.
    pub is_unusable: bool,
    /// True if a warning of the project's image files says so already.
    pub is_known: bool,
}

/// A view whose picture or mask cannot be used, and why.
pub type PictureFault = (ViewIndex, PictureError);

/// Names the first views with a fault and its `consequence`, and counts the rest.
///
/// Missing and unreadable image files are left out: the warnings of the project's image files have
/// them.
pub fn picture_warnings(scene: &Scene, faults: &[PictureFault], consequence: &str) -> Vec<String> {
    let faults: Vec<_> = faults.iter().filter(|(_, fault)| !fault.is_known).collect();
    // Decoders break lines.
    let one_line = |fault: &PictureError| {
        fault
            .to_string()
            .split_whitespace()
            .collect::<Vec<_>>()
            .join(" ")
    };
    let sentence = |(view, fault): &PictureFault| {
        format!("{}: {}; {consequence}", scene.name(*view), one_line(fault))
    };
    let mut warnings: Vec<String> = faults
        .iter()
        .take(NAMED)
        .map(|fault| sentence(fault))
        .collect();
    if let Some(others) = faults.len().checked_sub(NAMED).filter(|&others| others > 0) {
        warnings.push(format!("{others} more like these: {consequence}"));
    }
    warnings
}
