//! A small picture of a view, taken by an ideal pinhole camera.

use std::sync::OnceLock;

use nalgebra::{Point2, Point3};

use super::pinhole::Pinhole;

use crate::{
    method::confidence::{Grey, Mask, PictureError, Pictures},
    model::{
        camera::{Camera, CameraModel},
        scene::{Scene, ViewIndex},
    },
};

/// Long side of a thumbnail, pixels. At 120, the way from every n-th view to the best order is 0.02
/// shorter in the mean of nine sets; at 200 it is not longer, and costs twice as much.
pub const LONG_SIDE: f64 = 160.0;

/// The thumbnails of a scene's views.
#[derive(Debug)]
pub struct Thumbnails {
    /// By view; unset until its picture is read, `None` without one.
    of_view: Vec<OnceLock<Option<Thumbnail>>>,
}

impl Thumbnails {
    pub fn new(views: usize) -> Self {
        Self {
            of_view: (0..views).map(|_| OnceLock::new()).collect(),
        }
    }

    /// Returns the same pictures; thumbnails are taken of those that are read through them, so that
    /// each is decoded once.
    pub fn beside<'a>(&'a self, pictures: &'a dyn Pictures) -> PicturesWithThumbnails<'a> {
        PicturesWithThumbnails {
            pictures,
            thumbnails: self,
        }
    }

    /// Reads the picture of a view unless its thumbnail is there.
    pub fn read(
        &self,
        scene: &Scene,
        view: ViewIndex,
        (pictures, image_scale): (&dyn Pictures, f64),
    ) -> Option<&Thumbnail> {
        let read = || {
            let (grey, mask) = pictures.grey(scene, view, image_scale).ok()??;
            Thumbnail::of(scene, view, &grey, mask.as_ref())
        };
        self.of_view[view.index()].get_or_init(read).as_ref()
    }

    /// Returns the thumbnail of a view; `None` if it is not read or has no picture.
    pub fn of_view(&self, view: ViewIndex) -> Option<&Thumbnail> {
        self.of_view[view.index()].get()?.as_ref()
    }
}

/// Pictures of which thumbnails are taken.
pub struct PicturesWithThumbnails<'a> {
    pictures: &'a dyn Pictures,
    thumbnails: &'a Thumbnails,
}

impl Pictures for PicturesWithThumbnails<'_> {
    fn have_images(&self) -> bool {
        self.pictures.have_images()
    }

    fn grey(
        &self,
        scene: &Scene,
        view: ViewIndex,
        image_scale: f64,
    ) -> Result<Option<(Grey, Option<Mask>)>, PictureError> {
        let read = self.pictures.grey(scene, view, image_scale);
        if let Ok(Some((grey, mask))) = &read {
            let taken = || Thumbnail::of(scene, view, grey, mask.as_ref());
            self.thumbnails.of_view[view.index()].get_or_init(taken);
        }
        read
    }

    fn mask(&self, scene: &Scene, view: ViewIndex) -> Result<Option<Mask>, PictureError> {
        self.pictures.mask(scene, view)
    }
}

/// A small grey picture.
#[derive(Clone, Debug)]
pub struct Thumbnail {
    pub camera: Pinhole,
    /// Grey levels, 0 to 255, row by row.
    pub grey: Vec<u8>,
    /// The four neighbours of each pixel in one word, so that a sample is one load: the pixel
    /// itself, right, below and below right, lowest byte first; repeated at the border.
    pub(super) quads: Vec<u32>,
    /// True where the view's mask allows the pixel; empty without a mask.
    pub(super) allowed: Vec<bool>,
}

impl Thumbnail {
    /// Reduces the picture of a view; `None` if it is no perspective picture.
    fn of(scene: &Scene, view: ViewIndex, grey: &Grey, mask: Option<&Mask>) -> Option<Self> {
        let camera = scene.camera_of(view);
        if camera.model() == CameraModel::Equirectangular {
            return None;
        }
        let [width, height] = size(camera);
        let [sx, sy] = [
            width as f64 / f64::from(camera.width),
            height as f64 / f64::from(camera.height),
        ];
        let (focal, centre) = camera.pinhole_part();
        let mut thumbnail = Self {
            camera: Pinhole {
                width,
                height,
                focal: [focal.x * sx, focal.y * sy],
                centre: [centre.x * sx - 0.5, centre.y * sy - 0.5],
                pose: scene.view(view).cam_from_world,
            },
            grey: Vec::with_capacity(width * height),
            quads: Vec::new(),
            allowed: Vec::new(),
        };
        let level = grey.level_of(LONG_SIDE);
        for (x, y) in thumbnail.pixels() {
            let at = thumbnail.in_picture(camera, x, y, [sx, sy]);
            let share = [
                at.x / f64::from(camera.width),
                at.y / f64::from(camera.height),
            ];
            thumbnail.grey.push(grey.at(level, share));
            if let Some(mask) = mask {
                thumbnail.allowed.push(mask.allows(share[0], share[1]));
            }
        }
        thumbnail.quads = quads(&thumbnail.grey, width, height);
        Some(thumbnail)
    }

    fn pixels(&self) -> impl Iterator<Item = (usize, usize)> + use<> {
        let (width, height) = (self.camera.width, self.camera.height);
        (0..height).flat_map(move |y| (0..width).map(move |x| (x, y)))
    }

    /// Returns the position in the view's picture that a pixel shows.
    fn in_picture(&self, camera: &Camera, x: usize, y: usize, scale: [f64; 2]) -> Point2<f64> {
        let plain = Point2::new((x as f64 + 0.5) / scale[0], (y as f64 + 0.5) / scale[1]);
        if camera.is_pinhole() {
            return plain;
        }
        camera
            .project(&Point3::from(self.camera.ray(x, y)))
            .unwrap_or(plain)
    }
}

/// Returns width and height of the thumbnails of a camera.
pub fn size(camera: &Camera) -> [usize; 2] {
    let scale = LONG_SIDE / f64::from(camera.width.max(camera.height));
    [camera.width, camera.height].map(|side| (f64::from(side) * scale).round().max(8.0) as usize)
}

fn quads(grey: &[u8], width: usize, height: usize) -> Vec<u32> {
    let at = |x: usize, y: usize| u32::from(grey[y.min(height - 1) * width + x.min(width - 1)]);
    let quad = |x, y| at(x, y) | at(x + 1, y) << 8 | at(x, y + 1) << 16 | at(x + 1, y + 1) << 24;
    (0..height)
        .flat_map(|y| (0..width).map(move |x| quad(x, y)))
        .collect()
}
