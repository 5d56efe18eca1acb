//! Connected parts of a graph.

/// The nodes that hang together, as lists in ascending order; the lists by their first nodes. `beside`: the neighbours of a node; that one
/// of two nodes has the other for a neighbour is enough.
pub fn components<I: Iterator<Item = u32>>(nodes: usize, beside: impl Fn(u32) -> I) -> Vec<Vec<u32>> {
    let mut first: Vec<u32> = (0..nodes as u32).collect();
    for node in 0..nodes as u32 {
        for other in beside(node) {
            let (a, b) = (root(&mut first, node), root(&mut first, other));
            first[a.max(b) as usize] = a.min(b);
        }
    }
    let mut parts: Vec<Vec<u32>> = Vec::new();
    let mut place = vec![0; nodes];
    for node in 0..nodes as u32 {
        let first = root(&mut first, node);
        if first == node {
            place[node as usize] = parts.len();
            parts.push(Vec::new());
        }
        parts[place[first as usize]].push(node);
    }
    parts
}

/// The first node of those known to hang together with this one.
fn root(first: &mut [u32], mut of: u32) -> u32 {
    while first[of as usize] != of {
        first[of as usize] = first[first[of as usize] as usize];
        of = first[of as usize];
    }
    of
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_lists_in_order() {
        let edges = [vec![3], vec![], vec![5], vec![], vec![0], vec![]];
        let parts = components(6, |node| edges[node as usize].iter().copied());
        assert_eq!(parts, [vec![0, 3, 4], vec![1], vec![2, 5]]);
        assert!(components(0, |_| std::iter::empty()).is_empty());
    }
}
