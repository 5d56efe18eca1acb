//! Upper bound on the best set of clusters, and so on the loss of a ranking.

use super::{Maps, Objective, Ranking, Reached, SINGLE_MAP_CREDIT};
use crate::base::{
    column,
    vector::{Kernel, vectorised},
};

/// Number of subgradient steps; more hardly lower the bound.
const ROUNDS: usize = 20;
/// Steps without improvement after which the step length is halved.
const PATIENCE: usize = 3;
/// Triangles whose surplus is added at once.
const LANES: usize = 8;

/// Returns an upper bound on f_o of any set of maps that needs no more work than the first `length` of the ranking.
///
/// Any prices at the triangles give a bound (Lagrangian dual, method 5.2). They start from f of the ranking's first maps; a subgradient step raises
/// the price of triangles that the best maps at these prices cover more often than needed, and lowers the others.
pub fn most_of_any(length: usize, maps: &Maps, objective: &Objective, ranking: &Ranking) -> f64 {
    let all: Vec<u32> = (0..maps.len()).collect();
    let order: Vec<u32> = ranking.maps().map(|(cluster, scale)| maps.index(cluster, scale)).collect();
    let work_of = |maps_taken: &[u32]| maps_taken.iter().map(|&map| maps.work(map)).sum::<f64>();
    let mut reached = Reached::new(objective);
    let first = &order[..length.min(order.len())];
    first.iter().for_each(|&map| reached.take(maps.row(map)));
    let least: Vec<f32> = (0..objective.weights.len() as u32).map(|t| reached.largest(t)[0]).collect();
    let goal = reached.fulfilment();
    // All clusters at full size are an upper bound, too.
    let mut bound = match maps.has_half() {
        true => Reached::by_all(maps, objective).fulfilment(),
        // The ranking has taken all of them, in whole numbers, so that no other order gives another sum.
        false => ranking.fulfilment.last().copied().unwrap_or(0.0),
    };
    drop(reached);
    let limit = if length > order.len() { f64::INFINITY } else { work_of(first) };
    let mut dual = Dual::new(objective, least);
    let (mut step, mut in_vain) = (1.0, 0);
    for _ in 0..ROUNDS {
        let gains = column::read_by_parts(&all, |&map| dual.gain(maps.row(map)), || maps.release());
        let per_work = |map: u32| gains[map as usize] / maps.work(map);
        let mut best = all.clone();
        best.sort_by(|&a, &b| per_work(b).total_cmp(&per_work(a)));
        let (whole, part) = within(limit, &best, |map| maps.work(map));
        let next = best.get(whole).map_or(0.0, |&map| part * gains[map as usize]);
        best.truncate(whole);
        let most = dual.paid() + best.iter().map(|&map| gains[map as usize]).sum::<f64>() + next;
        in_vain = if most < bound { 0 } else { in_vain + 1 };
        bound = bound.min(most);
        if in_vain == PATIENCE {
            (step, in_vain) = (0.5 * step, 0);
        }
        dual.improve(best.iter().map(|&map| maps.row(map)), step * (most - goal));
    }
    maps.release();
    bound
}

/// Sums what a map's f are above the prices, times the weights.
struct Surplus<'a> {
    triangles: &'a [u32],
    values: &'a [f32],
    prices: &'a [f32],
    weights: &'a [f64],
}

impl Kernel for Surplus<'_> {
    type Output = f64;

    #[inline(always)]
    fn run(self) -> f64 {
        // Independent sums, which need not wait for each other.
        let mut sums = [0.0; LANES];
        for (triangles, values) in self.triangles.chunks(LANES).zip(self.values.chunks(LANES)) {
            for ((sum, &t), &f) in sums.iter_mut().zip(triangles).zip(values) {
                // In f64, where the difference is exact; rounded down in f32, it would no longer be a bound.
                *sum += self.weights[t as usize] * (f64::from(f) - f64::from(self.prices[t as usize])).max(0.0);
            }
        }
        sums.iter().sum()
    }
}

/// Returns the number of maps that fit into the work, and the fraction of the next one that would.
fn within(limit: f64, maps: &[u32], work: impl Fn(u32) -> f64) -> (usize, f64) {
    let mut left = limit;
    for (place, &map) in maps.iter().enumerate() {
        // Tolerance for sums of the same terms in another order.
        if work(map) > left * (1.0 + 1e-12) {
            return (place, left / work(map));
        }
        left -= work(map);
    }
    (maps.len(), 0.0)
}

/// Prices at each triangle: one for each of its m largest f, and one for the m-th.
///
/// For every p, the m largest f add up to at most m p + s, and the m-th is at most p + s / m, where s is the sum of max(f - p, 0) over all f.
struct Dual<'a> {
    objective: &'a Objective,
    prices: [Vec<f32>; 2],
    /// Weight in f_o of a unit of f above each of the two prices.
    shares: [f64; 2],
}

impl<'a> Dual<'a> {
    fn new(objective: &'a Objective, start: Vec<f32>) -> Self {
        let (m, e) = (f64::from(objective.support), SINGLE_MAP_CREDIT);
        let each = e / (m - 1.0);
        match objective.support {
            1 => Self { objective, prices: [start, Vec::new()], shares: [1.0, 0.0] },
            _ => Self {
                objective,
                prices: [start.clone(), start],
                shares: [each / (1.0 + e), (1.0 - each) / (m * (1.0 + e))],
            },
        }
    }

    fn in_force(&self) -> impl Iterator<Item = (&Vec<f32>, f64)> {
        self.prices.iter().zip(self.shares).filter(|(_, share)| *share > 0.0)
    }

    /// Returns the price that m clusters pay at all triangles together.
    fn paid(&self) -> f64 {
        let m = f64::from(self.objective.support);
        let of = |(prices, share): (&Vec<f32>, f64)| {
            let paid: f64 = prices.iter().zip(&self.objective.weights).map(|(&price, w)| w * f64::from(price)).sum();
            m * share * paid
        };
        self.in_force().map(of).sum()
    }

    /// Returns the surplus of a map over the prices.
    fn gain(&self, (triangles, values): (&[u32], &[f32])) -> f64 {
        let weights = &self.objective.weights;
        self.in_force().map(|(prices, share)| share * vectorised(Surplus { triangles, values, prices, weights })).sum()
    }

    /// Moves the prices against the subgradient of the bound; per unit of weight it is m minus the number of `best` clusters above the price. `gap`:
    /// target for the decrease of the bound.
    fn improve<'t>(&mut self, best: impl Iterator<Item = (&'t [u32], &'t [f32])>, gap: f64) {
        let weights = &self.objective.weights;
        let mut slopes = self.prices.each_ref().map(|prices| vec![self.objective.support as i32; prices.len()]);
        for (triangles, values) in best {
            for (slopes, prices) in slopes.iter_mut().zip(&self.prices).filter(|(_, prices)| !prices.is_empty()) {
                for (&t, &f) in triangles.iter().zip(values) {
                    slopes[t as usize] -= i32::from(f > prices[t as usize]);
                }
            }
        }
        let square = |(slopes, share): (&Vec<i32>, f64)| -> f64 {
            slopes.iter().zip(weights).map(|(&slope, w)| w * (share * f64::from(slope)).powi(2)).sum()
        };
        let squares: f64 = slopes.iter().zip(self.shares).map(square).sum();
        if !(squares > 0.0 && gap > 0.0) {
            return;
        }
        for ((prices, slopes), share) in self.prices.iter_mut().zip(&slopes).zip(self.shares) {
            for (price, &slope) in prices.iter_mut().zip(slopes) {
                let down = gap / squares * share * f64::from(slope);
                *price = (f64::from(*price) - down).clamp(0.0, 1.0) as f32;
            }
        }
    }
}
