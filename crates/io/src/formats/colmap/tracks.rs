//! Converts track elements to observations: views and measured pixels.

use std::{
    collections::HashMap,
    sync::{
        OnceLock,
        atomic::{AtomicUsize, Ordering},
    },
};

use rayon::prelude::*;
use viewrank_core::{
    base::large_pages,
    model::scene::{ModelWarning, View, ViewIndex, WarningKind},
};

use super::{ColmapImage, ColmapModel, ColmapPoint, Point2d, TrackElement};
use crate::formats::{Fault, Problem};

/// Points per parallel work item.
const CHUNK: usize = 4096;
/// Points whose 2D points are prefetched at a time: a few hundred kilobytes.
const WARMED: usize = 256;

/// The image and view of an image id.
#[derive(Clone, Copy, Debug)]
pub(super) struct ImageView {
    /// Index of the image in the file.
    pub position: u32,
    pub view: ViewIndex,
}

/// Lookup by image id.
pub(super) struct ImageIds {
    /// Array indexed by id, for the dense range of ids: it is accessed for each track element.
    dense: Vec<Option<ImageView>>,
    sparse: HashMap<u32, ImageView>,
}

impl ImageIds {
    /// # Errors
    /// The index of the first view with a duplicate image id.
    pub(super) fn new(views: &[View]) -> Result<Self, u32> {
        let mut ids = Self {
            // In proportion to the views, however large a single id is.
            dense: vec![None; 1024 + 4 * views.len()],
            sparse: HashMap::new(),
        };
        for (index, view) in views.iter().enumerate() {
            let image_view = ImageView {
                position: view.file_position,
                view: ViewIndex(index as u32),
            };
            let before = match ids.dense.get_mut(view.image_id as usize) {
                Some(slot) => slot.replace(image_view),
                None => ids.sparse.insert(view.image_id, image_view),
            };
            if before.is_some() {
                return Err(index as u32);
            }
        }
        Ok(ids)
    }

    pub(super) fn get(&self, id: u32) -> Option<ImageView> {
        match self.dense.get(id as usize) {
            Some(slot) => *slot,
            None => self.sparse.get(&id).copied(),
        }
    }
}

/// The tracks of a [`Scene`].
pub(super) struct Tracks {
    pub offsets: Vec<usize>,
    pub views: Vec<ViewIndex>,
    pub pixels: Vec<[f64; 2]>,
}

/// The images' lists of 2D points, to which tracks refer.
pub(super) struct ImageLists<'m> {
    view_of_image: &'m ImageIds,
    /// In file order.
    pub links: Vec<Links<'m>>,
    /// Those of `links` alone, small enough to stay in the processor's cache while tracks are
    /// followed.
    points2d: Vec<&'m [Point2d]>,
    /// Number of track elements that disagreed with the lists.
    followed: AtomicUsize,
}

impl<'m> ImageLists<'m> {
    pub(super) fn new(images: &'m [ColmapImage<'m>], view_of_image: &'m ImageIds) -> Self {
        let links = images
            .iter()
            .map(|image| Links {
                image,
                by_point: OnceLock::new(),
            })
            .collect();
        let points2d = images.iter().map(|image| &*image.points2d).collect();
        Self {
            view_of_image,
            links,
            points2d,
            followed: AtomicUsize::new(0),
        }
    }

    /// Prefetches the 2D points of some points, which are scattered over the file: in a loop
    /// without other work the processor overlaps the cache misses. That saves more than half of the
    /// reading time.
    fn warm(&self, points: &[ColmapPoint]) {
        let mut seen = 0;
        for element in points.iter().flat_map(|point| point.track.iter()) {
            let Some(image_view) = self.view_of_image.get(element.image()) else {
                continue;
            };
            if let Some(point2d) =
                self.points2d[image_view.position as usize].get(element.index() as usize)
            {
                seen ^= point2d.x[0] ^ point2d.point[7];
            }
        }
        // The compiler would drop reads whose result nobody takes.
        std::hint::black_box(seen);
    }

    /// Warnings of tracks and lists that disagree, when all `elements` of the tracks are resolved.
    pub(super) fn warnings(&self, elements: usize) -> impl Iterator<Item = ModelWarning> {
        self.followed(elements)
            .into_iter()
            .chain(self.unanswered(elements))
    }

    fn followed(&self, elements: usize) -> Option<ModelWarning> {
        let followed = self.followed.load(Ordering::Relaxed);
        (followed > 0).then(|| {
            let text = format!(
                "{followed} of {elements} track elements name another 2D point than the images' own lists (OpenMVG and \
                 AliceVision write the number of the feature there); the lists were followed"
            );
            ModelWarning::new(WarningKind::Damaged, text)
        })
    }
}

impl ImageLists<'_> {
    /// Number of 2D points that refer to a sparse point whose track lacks them; COLMAP counts them,
    /// but they have no effect.
    fn unanswered(&self, elements: usize) -> Option<ModelWarning> {
        let linked = |links: &Links| {
            links
                .image
                .points2d
                .iter()
                .filter(|p| p.point().is_some())
                .count()
        };
        let linked: usize = self.links.par_iter().map(linked).sum();
        // Tracks may claim more 2D points than the lists link to points.
        linked.checked_sub(elements).filter(|unanswered| *unanswered > 0).map(|unanswered| {
            let text = format!(
                "{unanswered} of {linked} 2D points in the images' lists name sparse points that are not there or do not name them; they \
                 are no observations"
            );
            ModelWarning::new(WarningKind::Damaged, text)
        })
    }
}

/// An image's 2D points by observed sparse point, sorted at first use.
pub(super) struct Links<'m> {
    pub image: &'m ColmapImage<'m>,
    by_point: OnceLock<Vec<(u64, u32)>>,
}

impl<'m> Links<'m> {
    /// The n-th 2D point of the image that observes the point, with its index in the list.
    fn nth(&self, point: u64, n: usize) -> Option<(u32, &'m Point2d)> {
        let by_point = self.by_point.get_or_init(|| {
            let linked = self.image.points2d.iter().enumerate();
            let mut linked: Vec<_> = linked
                .filter_map(|(i, p)| p.point().map(|id| (id, i as u32)))
                .collect();
            linked.sort_unstable();
            linked
        });
        let first = by_point.partition_point(|&(id, _)| id < point);
        let &(id, index) = by_point.get(first + n)?;
        (id == point).then(|| (index, &self.image.points2d[index as usize]))
    }
}

impl ColmapModel<'_> {
    /// Positions of the first observations of the points, and the number of all.
    fn track_offsets(&self) -> Vec<usize> {
        let lengths: Vec<usize> = self
            .points
            .par_iter()
            .map(|point| point.track.len())
            .collect();
        let mut offsets = Vec::with_capacity(self.points.len() + 1);
        let mut end = 0;
        offsets.push(end);
        for length in lengths {
            end += length;
            offsets.push(end);
        }
        offsets
    }

    /// Computes the views and pixels of all observations; parts of the arrays are filled in
    /// parallel.
    pub(super) fn tracks(&self, lists: &ImageLists) -> Result<Tracks, Fault> {
        let offsets = self.track_offsets();
        let total = offsets[self.points.len()];
        let (mut views, mut pixels) = (large_pages::zeroed(total), large_pages::zeroed(total));
        let pieces = Piece::all(&self.points, &offsets, &mut views, &mut pixels);
        let fill = |piece: Piece| piece.fill(lists);
        let results: Vec<Result<(), Fault>> = pieces.into_par_iter().map(fill).collect();
        // The first fault in file order, independent of the threads.
        results.into_iter().collect::<Result<(), Fault>>()?;
        Ok(Tracks {
            offsets,
            views,
            pixels,
        })
    }
}

/// A range of points, and the part of the arrays for their observations.
struct Piece<'p> {
    points: &'p [ColmapPoint<'p>],
    views: &'p mut [ViewIndex],
    pixels: &'p mut [[f64; 2]],
}

impl<'p> Piece<'p> {
    /// Divides all points, with the offsets of their observations.
    fn all(
        points: &'p [ColmapPoint<'p>],
        offsets: &[usize],
        mut views: &'p mut [ViewIndex],
        mut pixels: &'p mut [[f64; 2]],
    ) -> Vec<Self> {
        let mut pieces = Vec::with_capacity(points.len() / CHUNK + 1);
        for (n, points) in points.chunks(CHUNK).enumerate() {
            let first = n * CHUNK;
            let observations = offsets[first + points.len()] - offsets[first];
            // Parts that do not overlap, so that threads need no lock.
            let (own_views, views_left) = views.split_at_mut(observations);
            let (own_pixels, pixels_left) = pixels.split_at_mut(observations);
            (views, pixels) = (views_left, pixels_left);
            pieces.push(Self {
                points,
                views: own_views,
                pixels: own_pixels,
            });
        }
        pieces
    }

    fn fill(self, lists: &ImageLists) -> Result<(), Fault> {
        let mut observations = Vec::new();
        let mut next = 0;
        for points in self.points.chunks(WARMED) {
            lists.warm(points);
            for point in points {
                point.observations(lists, &mut observations)?;
                for &(view, pixel) in &observations {
                    (self.views[next], self.pixels[next]) = (view, pixel);
                    next += 1;
                }
            }
        }
        Ok(())
    }
}

/// Numbers of elements per image among the first ones of a track. Counting continues only when an
/// index must be found.
#[derive(Default)]
struct ElementCounts {
    by_image: HashMap<u32, usize>,
    counted: usize,
}

impl ElementCounts {
    /// Number of elements of the n-th one's image before it.
    fn before(&mut self, track: &[TrackElement], n: usize) -> usize {
        for element in &track[self.counted..n] {
            *self.by_image.entry(element.image()).or_default() += 1;
        }
        self.counted = n;
        let of_image = self.by_image.get(&track[n].image());
        of_image.copied().unwrap_or(0)
    }
}

impl ColmapPoint<'_> {
    /// Finds the 2D point of each element of the track.
    pub(super) fn resolve<'m>(
        &self,
        lists: &ImageLists<'m>,
        mut each: impl FnMut(ImageView, u32, &'m Point2d) -> Result<(), Fault>,
    ) -> Result<(), Fault> {
        let mut counts = ElementCounts::default();
        for (n, element) in self.track.iter().enumerate() {
            let image_view = lists
                .view_of_image
                .get(element.image())
                .ok_or_else(|| self.absent(element))?;
            let position = image_view.position as usize;
            let named = lists.points2d[position].get(element.index() as usize);
            match named {
                // A track may claim a 2D point that is linked to no point.
                Some(point2d) if point2d.point().is_none_or(|id| id == self.id) => {
                    each(image_view, element.index(), point2d)?;
                }
                _ => {
                    let before = counts.before(&self.track, n);
                    let (index, point2d) = lists.links[position]
                        .nth(self.id, before)
                        .ok_or_else(|| self.wrong_index(element, named))?;
                    lists.followed.fetch_add(1, Ordering::Relaxed);
                    each(image_view, index, point2d)?;
                }
            }
        }
        Ok(())
    }

    /// Computes view and pixel of each element of the track, sorted by view.
    fn observations(
        &self,
        lists: &ImageLists,
        observations: &mut Vec<(ViewIndex, [f64; 2])>,
    ) -> Result<(), Fault> {
        observations.clear();
        observations.reserve(self.track.len());
        if !self.xyz.iter().all(|v| v.is_finite()) {
            return Err(self.fault(Problem::NotFinite("the position")));
        }
        self.resolve(lists, |image_view, _, point2d| {
            let pixel = point2d.pixel();
            if !pixel.iter().all(|v| v.is_finite()) {
                let image = lists.links[image_view.position as usize].image;
                return Err(image.fault(Problem::NotFinite("a 2D point")));
            }
            observations.push((image_view.view, pixel));
            Ok(())
        })?;
        // A stable sort: repeated measurements of a view keep the order of the track.
        observations.sort_by_key(|o| o.0);
        Ok(())
    }

    fn absent(&self, element: &TrackElement) -> Fault {
        self.fault(Problem::absent("image", element.image()))
    }

    fn wrong_index(&self, element: &TrackElement, named: Option<&Point2d>) -> Fault {
        let why = match named.and_then(Point2d::point) {
            Some(other) => format!("which observes point {other}"),
            None => "which has no such 2D point".into(),
        };
        self.fault(Problem::TrackIndex {
            image: element.image(),
            index: element.index(),
            why,
        })
    }
}
