//! Samples all pictures and compares pairs.

use std::sync::Mutex;

use super::{
    super::pictures::{PictureFault, Pictures},
    ProgramReach, packed,
    stacks::{self, STACK, Spacing, correlation, stacks},
};
use crate::{
    base::{
        column::{self, Column, ColumnBuilder, Storage, TableError},
        large_pages,
        progress::{Stage, StepCounter, Watcher},
    },
    method::geometry::Geometry,
    model::{cluster::Reach, scene::ViewIndex},
};

/// Room for samples and the pictures that they are taken from.
#[derive(Clone, Copy, Debug)]
pub struct SampleRoom {
    /// Place of the samples.
    pub keep: Storage,
    /// Views that are sampled per batch, at least 1.
    pub views_at_once: usize,
}

/// What is taken from the pictures.
pub(super) struct Sampled {
    /// [`STACK`] samples for each row of visibility.
    pub samples: Column<i8>,
    /// By view, [`Grey::detail`](super::Grey::detail); zeros without a picture.
    pub detail: Vec<[f64; 2]>,
    /// Faults of the views without samples, by view.
    pub faults: Vec<PictureFault>,
}

/// Samples all pictures.
pub(super) fn samples(
    geometry: &Geometry,
    pictures: &dyn Pictures,
    room: SampleRoom,
    watcher: &dyn Watcher,
) -> Result<Sampled, TableError> {
    let visibility = geometry.visibility;
    let views = visibility.views();
    let steps = StepCounter::start(watcher, Stage::Confidence, views.len());
    let sampler = Sampler::new(geometry, pictures);
    let mut samples = ColumnBuilder::new(room.keep)?;
    samples.reserve(visibility.triangles.len() * STACK);
    let mut detail = Vec::with_capacity(views.len());
    column::in_order(
        &views,
        room.views_at_once,
        || (),
        |(), &view| steps.run(|| sampler.of_view(view)),
        |_, taken| {
            visibility.triangles.release();
            for (samples_of_view, detail_of_view) in taken {
                samples.extend(&samples_of_view)?;
                detail.push(detail_of_view);
            }
            // Else the next batch comes on top of what the allocator holds back of this one.
            large_pages::return_freed_memory();
            Ok(())
        },
    )?;
    Ok(Sampled {
        samples: samples.finish()?,
        detail,
        faults: sampler.into_faults(),
    })
}

struct Sampler<'a> {
    geometry: &'a Geometry<'a>,
    pictures: &'a dyn Pictures,
    spacing: Spacing,
    faults: Mutex<Vec<PictureFault>>,
}

impl<'a> Sampler<'a> {
    fn new(geometry: &'a Geometry<'a>, pictures: &'a dyn Pictures) -> Self {
        Self {
            geometry,
            pictures,
            spacing: Spacing::new(geometry),
            faults: Mutex::default(),
        }
    }

    fn into_faults(self) -> Vec<PictureFault> {
        let mut faults = self.faults.into_inner().unwrap_or_default();
        // Threads add them in any order.
        faults.sort_by_key(|(view, _)| *view);
        faults
    }

    /// Returns the samples of a view's picture and its detail, as of a view that sees nothing where
    /// there is no picture.
    fn of_view(&self, view: ViewIndex) -> (Vec<i8>, [f64; 2]) {
        let geometry = self.geometry;
        let picture = self
            .pictures
            .grey(geometry.scene, view, geometry.image_scale);
        let picture = picture.unwrap_or_else(|fault| {
            self.faults
                .lock()
                .map(|mut faults| faults.push((view, fault)))
                .ok();
            None
        });
        match picture {
            Some((grey, mask)) => {
                let stacks = stacks(geometry, &self.spacing, view, &grey, mask.as_ref());
                (stacks, grey.detail())
            }
            None => {
                let rows = geometry.visibility.triangles_seen_by(view).len();
                (vec![stacks::NOT_SEEN; rows * STACK], [0.0; 2])
            }
        }
    }
}

/// Returns the agreement of the key view with each partner, by partner, then row of the key view; 0
/// beyond the reach of the program.
pub(super) fn compared(
    geometry: &Geometry,
    samples: &Column<i8>,
    key: ViewIndex,
    partners: &[ViewIndex],
    reach: &ProgramReach,
    places: &mut [u32],
) -> Vec<u8> {
    let seen = geometry.visibility.triangles_seen_by(key);
    (0..)
        .zip(seen)
        .for_each(|(row, &t)| places[t as usize] = row);
    let mut values = vec![0; partners.len() * seen.len()];
    let reach_of = (reach.of_key_view)(key);
    let picture = KeyPicture {
        geometry,
        samples,
        first: geometry.visibility.rows(key).start,
        places,
    };
    // Chunks of 0 would panic for a view that sees nothing.
    let rows = values.chunks_exact_mut(seen.len().max(1));
    for (&partner, values) in partners.iter().zip(rows) {
        picture.compare(partner, &reach_of(partner), values);
    }
    seen.iter().for_each(|&t| places[t as usize] = u32::MAX);
    values
}

/// Samples of a key view's picture.
struct KeyPicture<'a> {
    geometry: &'a Geometry<'a>,
    samples: &'a Column<i8>,
    /// First row of the key view.
    first: usize,
    /// By triangle, its place among the rows of the key view; `u32::MAX` if it does not see it.
    places: &'a [u32],
}

impl KeyPicture<'_> {
    /// Writes the agreement with a partner on what both see and the program reaches.
    fn compare(&self, partner: ViewIndex, reach: &Reach, values: &mut [u8]) {
        let Geometry {
            visibility,
            surface,
            ..
        } = *self.geometry;
        let seen = visibility.triangles_seen_by(partner);
        for (row, &t) in visibility.rows(partner).zip(seen) {
            let place = self.places[t as usize];
            if place != u32::MAX && reach.includes(|| surface.centroid(t)) {
                let [a, b] = [self.first + place as usize, row]
                    .map(|row| &self.samples[row * STACK..][..STACK]);
                values[place as usize] = packed(correlation(a, b));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{
        ReachOfPartner,
        tests::{town, view_that_overlaps},
    };
    use super::*;

    /// Samples that are the same in all views of a triangle, and differ from those of other
    /// triangles.
    fn textured(geometry: &Geometry) -> Column<i8> {
        let rows = geometry
            .scene
            .view_indices()
            .flat_map(|view| geometry.visibility.triangles_seen_by(view));
        let sample = |t: u32, i: usize| ((t as usize * 31 + i * i * 17) % 37) as i8 - 18;
        rows.flat_map(|&t| (0..STACK).map(move |i| sample(t, i)))
            .collect::<Vec<_>>()
            .into()
    }

    #[test]
    fn values_are_of_triangles_that_both_see_and_the_program_reaches() {
        let town = town();
        let geometry = town.geometry(1.0);
        let (samples, key, partner) = (
            textured(&geometry),
            ViewIndex(12),
            view_that_overlaps(&geometry, ViewIndex(12)),
        );
        let mut places = vec![u32::MAX; town.surface.triangles.len()];
        let middle = town.scene.view(key).cam_from_world.centre().x;
        let part = move |_| {
            Reach::Part(Box::new(move |point: &nalgebra::Point3<f64>| {
                point.x < middle
            }))
        };
        let of_part = move |_| -> ReachOfPartner { Box::new(part) };
        let reaches: [&(dyn Fn(ViewIndex) -> ReachOfPartner<'static> + Sync); 3] =
            [&|_| Box::new(|_| Reach::Everything), &of_part, &|_| {
                Box::new(|_| Reach::Nothing)
            }];
        let seen = town.visibility.triangles_seen_by(key);
        let counts = reaches.map(|of_key_view| {
            let reach = ProgramReach {
                program: Some("program"),
                of_key_view,
            };
            let values = compared(
                &geometry,
                &samples,
                key,
                &[partner, partner],
                &reach,
                &mut places,
            );
            assert!(
                places.iter().all(|&place| place == u32::MAX),
                "left as found"
            );
            let (first, second) = values.split_at(seen.len());
            assert_eq!(first, second);
            for (&t, &value) in seen.iter().zip(first) {
                let is_reached = match of_key_view(key)(partner) {
                    Reach::Nothing => false,
                    Reach::Everything => true,
                    Reach::Part(is_inside) => is_inside(&town.surface.centroid(t)),
                };
                assert_eq!(
                    value > 0,
                    is_reached && town.visibility.row(partner, t).is_some(),
                    "{t}"
                );
            }
            first.iter().filter(|&&value| value > 0).count()
        });
        assert!(
            counts[0] > counts[1] && counts[1] > counts[2] && counts[2] == 0,
            "{counts:?}"
        );
    }
}
