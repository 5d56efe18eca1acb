//! The method of viewrank on arrays: which views of a photogrammetric block should get a depth map,
//! against which others each should be matched, and in which order, before any is computed.
//!
//! This crate reads and writes no file, and knows no program. Each section of [the method] is a
//! module, whose page says what it computes, with the formula and an example on arrays. In the
//! order of the method:
//!
//! | section | module | result |
//! | --- | --- | --- |
//! | 1 Surface | [`method::surface`] | [`Surface`](model::surface::Surface), from the sparse points of a [`Scene`](model::scene::Scene) |
//! | 2 Visibility | [`method::visibility`] | [`Visibility`](method::visibility::Visibility): the triangles that each view sees |
//! | 3 Fulfilment | [`method::fulfilment`] | f of a triangle and a view cluster, from the [`Model`](method::fulfilment::Model) |
//! | 3.6 Deep scenes | [`method::target`] | [`Target`](method::target::Target): wanted resolution and accuracy of each triangle |
//! | 4 Twins | [`method::twins`] | a [`Twin`](method::twins::Twin) for each view that is set aside |
//! | 4 Partners | [`method::partners`] | a [`ViewCluster`](model::cluster::ViewCluster) for each key view, and its row of the [`FulfilmentTable`](method::fulfilment::FulfilmentTable) |
//! | 5 Ranking | [`method::ranking`] | [`Ranking`](method::ranking::Ranking): the order of the clusters |
//! | 5.3 to 5.6 Cut, forecast, reasons | [`decision`] | [`Decision`](decision::Decision), from the [`Tables`](decision::Tables) of all sections |
//! | 5.7 Region | [`method::region`] | [`Region`](method::region::Region): the part of the surface that counts |
//! | 5.9 Pilot | [`method::pilot`] | [`Places`](method::pilot::Places) on which maps of thumbnails agree |
//! | 7 Confidence | [`method::confidence`] | p_i: what is likely to match, from pictures or from geometry |
//!
//! [`model`] has cameras, views, points, surface and clusters; [`base`] what is not photogrammetry.
//! Options of a section are a struct beside it, whose defaults are those of the method. Pictures
//! come through the trait [`Pictures`](method::confidence::Pictures). The feature `schema` adds
//! JSON Schema to options and results.
//!
//! [the method]: https://github.com/viewrank/viewrank/blob/main/docs/method.md
//!
//! # From points to a ranking
//!
//! ```
//! use viewrank_core::{
//!     base::{column::Storage, progress::NoWatcher},
//!     method::{
//!         confidence::Unary,
//!         partners::{self, Limits, PartnerSettings},
//!         ranking::{self, Objective, TriangleWeight},
//!         synthetic::Town,
//!         target::TargetSettings,
//!         visibility::Shown,
//!     },
//!     model::cluster::Gate,
//! };
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // A scene with its surface, visibility and target; `Scene::from_arrays` makes one of arrays.
//! let town = Town { edge: 4.0, points: 300, ..Town::default() }
//!     .seen(&TargetSettings::default(), 0.05, Storage::Memory);
//! let unary = Unary::certain();
//! let model = town.model(&unary);
//!
//! let (settings, points) = (PartnerSettings::default(), town.scene.view_points());
//! let limits = Limits::gate(&Gate::OPEN);
//! let candidates = partners::candidates(&town.scene, &points, &settings, &limits, &NoWatcher)?;
//! let (clusters, fulfilment) = partners::choose(&model, &candidates, &settings, 0, &NoWatcher)?;
//!
//! let shown = Shown::new(&town.scene, &town.surface, &town.visibility);
//! let objective = Objective::new(&town.surface, &shown, TriangleWeight::Pixels, None, 2);
//! let ranking = ranking::rank(&fulfilment, &objective, &NoWatcher)?;
//! let first = &clusters[ranking.order[0] as usize];
//! println!("{} with {} partners", town.scene.name(first.key), first.partners.len());
//! assert!(ranking.share(10) > ranking.share(5));
//! # Ok(())
//! # }
//! ```

#![deny(clippy::print_stdout, clippy::print_stderr)]

pub mod base;
pub mod decision;
pub mod method;
pub mod model;
