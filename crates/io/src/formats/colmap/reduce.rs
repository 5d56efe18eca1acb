//! Makes models to write: a part of a model, or the model of a scene in another format.

use std::{borrow::Cow, collections::HashSet};

use nalgebra::Vector3;
use viewrank_core::model::{
    camera::Camera,
    scene::{PointIndex, Scene, mean},
};

use super::{ColmapImage, ColmapModel, ColmapPoint, Point2d, TrackElement, tracks::ImageLists};
use crate::formats::{Fault, Place};

/// Use of an image in a part of a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImageUse {
    /// Kept, and a view that counts for its points.
    Counting,
    Kept,
    Removed,
}

impl ColmapModel<'_> {
    /// Reduces the model to some of its images. Ids don't change. The kept images keep their lists
    /// of 2D points, in which removed points become "no point". Points keep the track elements of
    /// kept images; those that fewer than `min_views` counting images observe are removed, as are
    /// unused cameras. Rigs and frames are removed: those of the whole model would contradict the
    /// rest.
    pub fn reduced(
        &self,
        use_of: impl Fn(&ColmapImage) -> ImageUse,
        min_views: usize,
    ) -> Result<ColmapModel<'_>, Fault> {
        let (_, view_of_image) = self.views(&self.cameras_by_id()?)?;
        let lists = ImageLists::new(&self.images, &view_of_image);
        let uses: Vec<ImageUse> = self.images.iter().map(use_of).collect();
        let points = self.points_of(&lists, &uses, min_views)?;
        let ids: HashSet<u64> = points.iter().map(|point| point.id).collect();
        let images = self.images_of(&uses, &ids);
        Ok(ColmapModel {
            cameras: self.cameras_of(&images),
            images,
            points,
            warnings: self.warnings.clone(),
            ..ColmapModel::default()
        })
    }

    /// The points that enough of the counting images observe.
    fn points_of(
        &self,
        lists: &ImageLists,
        uses: &[ImageUse],
        min_views: usize,
    ) -> Result<Vec<ColmapPoint<'static>>, Fault> {
        let points = self.points.iter();
        let points = points.map(|point| point.reduced(lists, uses, min_views));
        points.filter_map(Result::transpose).collect()
    }

    /// The kept images, with links to these points.
    fn images_of(&self, uses: &[ImageUse], points: &HashSet<u64>) -> Vec<ColmapImage<'_>> {
        let images = self.images.iter().zip(uses);
        let kept = images.filter(|(_, used)| **used != ImageUse::Removed);
        kept.map(|(image, _)| image.reduced(points)).collect()
    }

    /// The cameras that some of the images have.
    fn cameras_of(&self, images: &[ColmapImage]) -> Vec<Camera> {
        let used: HashSet<u32> = images.iter().map(|image| image.camera_id).collect();
        let cameras = self.cameras.iter();
        let used = cameras.filter(|camera| used.contains(&camera.id));
        used.cloned().collect()
    }

    /// Returns a copy of the model whose world origin is at `origin`.
    pub fn moved(mut self, origin: Vector3<f64>) -> Result<Self, Fault> {
        if origin == Vector3::zeros() {
            return Ok(self);
        }
        for image in &mut self.images {
            let pose = image
                .cam_from_world
                .pose()
                .map_err(|problem| Fault::new("images", image.at, problem))?;
            // R (x + origin) + t = R x + (t + R origin)
            image.cam_from_world.translation = (pose.translation + pose.rotation * origin).into();
        }
        for point in &mut self.points {
            point.xyz = (Vector3::from(point.xyz) - origin).into();
        }
        Ok(self)
    }

    /// Makes the model of a scene. Image ids are the scene's if they are positive and unique,
    /// otherwise 1, 2, ... by name; the images' lists of 2D points are their observations.
    pub fn from_scene(scene: &Scene) -> ColmapModel<'static> {
        let ids = image_ids(scene);
        let mut lists = vec![Vec::new(); scene.views.len()];
        let points = (0..scene.points.len() as u32).map(PointIndex);
        let points = points.map(|point| ColmapPoint::of_scene(scene, point, &ids, &mut lists));
        // Before the images, whose lists this fills.
        let points = points.collect();
        let images = scene.views.iter().zip(ids).zip(lists);
        let images = images.map(|((view, id), list)| ColmapImage {
            id,
            cam_from_world: (&view.cam_from_world).into(),
            camera_id: scene.cameras[view.camera.index()].id,
            name: Cow::Owned(view.name.clone()),
            points2d: Cow::Owned(list),
            at: Place::File,
        });
        ColmapModel {
            cameras: scene.cameras.clone(),
            images: images.collect(),
            points,
            ..ColmapModel::default()
        }
    }
}

/// Image ids by view: the scene's if they are positive and unique, otherwise 1, 2, ...
fn image_ids(scene: &Scene) -> Vec<u32> {
    let given = scene.views.iter().map(|view| view.image_id);
    let unique: HashSet<u32> = given.clone().collect();
    if unique.len() == scene.views.len() && !unique.contains(&0) {
        given.collect()
    } else {
        (1..).take(scene.views.len()).collect()
    }
}

impl ColmapImage<'_> {
    /// Returns the image with links to these points only.
    fn reduced(&self, points: &HashSet<u64>) -> ColmapImage<'_> {
        let relink =
            |p: &Point2d| Point2d::new(p.pixel(), p.point().filter(|id| points.contains(id)));
        let points2d = Cow::Owned(self.points2d.iter().map(relink).collect());
        ColmapImage {
            name: Cow::Borrowed(&self.name),
            points2d,
            ..*self
        }
    }
}

impl ColmapPoint<'static> {
    /// Makes the point of a scene; adds its observations to the lists of 2D points.
    fn of_scene(
        scene: &Scene,
        point: PointIndex,
        image_ids: &[u32],
        lists: &mut [Vec<Point2d>],
    ) -> Self {
        let p = point.index();
        let id = scene.point_ids[p];
        let track = scene.track(point).map(|o| {
            let view = scene.track_views[o].index();
            lists[view].push(Point2d::new(scene.track_pixels[o], Some(id)));
            TrackElement::new(image_ids[view], lists[view].len() as u32 - 1)
        });
        let track = Cow::Owned(track.collect());
        let observations = scene.track(point);
        let errors = observations.filter_map(|o| scene.reprojection_error(point, o));
        Self {
            id,
            xyz: scene.points[p].into(),
            colour: scene.colours[p],
            error: mean(errors).unwrap_or(-1.0),
            track,
            at: Place::File,
        }
    }
}

impl ColmapPoint<'_> {
    /// Returns the point with the track elements of the kept images (in file order).
    fn reduced(
        &self,
        lists: &ImageLists,
        uses: &[ImageUse],
        min_views: usize,
    ) -> Result<Option<ColmapPoint<'static>>, Fault> {
        let (mut track, mut views) = (Vec::new(), HashSet::new());
        self.resolve(lists, |image_view, index, _| {
            let position = image_view.position as usize;
            let image = lists.links[position].image.id;
            if uses[position] != ImageUse::Removed {
                track.push(TrackElement::new(image, index));
            }
            // An image may observe a point twice, and is one view.
            if uses[position] == ImageUse::Counting {
                views.insert(image);
            }
            Ok(())
        })?;
        let Self {
            id,
            xyz,
            colour,
            error,
            at,
            ..
        } = *self;
        let reduced = ColmapPoint {
            id,
            xyz,
            colour,
            error,
            track: Cow::Owned(track),
            at,
        };
        Ok((views.len() >= min_views).then_some(reduced))
    }
}
