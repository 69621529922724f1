//! Which values of earlier regions a region stores rather than recomputes: a minimum cut.
//!
//! A region needs some values that regions before it compute over the same domain. Any set of stored values that separates
//! what it needs from what is too expensive to compute again will do; the smallest one, in channels, is a minimum vertex
//! cut between the two (as in the partitioning of forward and backward passes in PyTorch's AOTAutograd). Expensive values
//! that are too wide to store do not count: they are recomputed.

use std::collections::{HashMap, VecDeque};

/// A value that could be stored.
pub(super) struct Candidate {
    pub id: u64,
    /// Cost of storing it.
    pub channels: u64,
    /// It must not be computed again: it or something computed from it is stored.
    pub expensive: bool,
    /// The candidates it is computed from.
    pub operands: Vec<u64>,
}

/// The cheapest set of candidates to store, so that `needed` can be computed without computing expensive ones again.
pub(super) fn choose(candidates: &[Candidate], needed: &[u64]) -> Vec<u64> {
    let index: HashMap<u64, usize> = candidates.iter().enumerate().map(|(i, c)| (c.id, i)).collect();
    let (source, sink) = (2 * candidates.len(), 2 * candidates.len() + 1);
    let mut flow = Flow::new(2 * candidates.len() + 2);
    for (i, c) in candidates.iter().enumerate() {
        flow.edge(2 * i, 2 * i + 1, c.channels);
        if c.expensive {
            flow.edge(source, 2 * i, u64::MAX);
        }
        for o in &c.operands {
            flow.edge(2 * index[o] + 1, 2 * i, u64::MAX);
        }
    }
    for n in needed {
        flow.edge(2 * index[n] + 1, sink, u64::MAX);
    }
    flow.maximise(source, sink);
    // Of all minimum cuts the one nearest to the needs: what is stored is then used as it is.
    let ahead = flow.reaches(sink);
    let cut = |i: &usize| !ahead[2 * i] && ahead[2 * i + 1];
    (0..candidates.len()).filter(cut).map(|i| candidates[i].id).collect()
}

/// Maximum flow by shortest augmenting paths (Edmonds and Karp).
struct Flow {
    /// Edges from every node, as indices into `to` and `room`; edge `e ^ 1` is the reverse of `e`.
    from: Vec<Vec<usize>>,
    to: Vec<usize>,
    room: Vec<u64>,
}

impl Flow {
    fn new(nodes: usize) -> Flow {
        Flow { from: vec![vec![]; nodes], to: vec![], room: vec![] }
    }

    fn edge(&mut self, a: usize, b: usize, room: u64) {
        self.from[a].push(self.to.len());
        self.to.push(b);
        self.room.push(room);
        self.from[b].push(self.to.len());
        self.to.push(a);
        self.room.push(0);
    }

    /// Which nodes still have room to the sink.
    fn reaches(&self, sink: usize) -> Vec<bool> {
        let mut ahead = vec![false; self.from.len()];
        ahead[sink] = true;
        let mut stack = vec![sink];
        while let Some(b) = stack.pop() {
            for e in &self.from[b] {
                // The reverse of an edge out of b is an edge into it.
                if self.room[e ^ 1] > 0 && !ahead[self.to[*e]] {
                    ahead[self.to[*e]] = true;
                    stack.push(self.to[*e]);
                }
            }
        }
        ahead
    }

    /// Saturates the network.
    fn maximise(&mut self, source: usize, sink: usize) {
        loop {
            let mut by: Vec<Option<usize>> = vec![None; self.from.len()];
            let mut reached = vec![false; self.from.len()];
            reached[source] = true;
            let mut queue = VecDeque::from([source]);
            while let Some(a) = queue.pop_front() {
                for e in &self.from[a] {
                    if self.room[*e] > 0 && !reached[self.to[*e]] {
                        reached[self.to[*e]] = true;
                        by[self.to[*e]] = Some(*e);
                        queue.push_back(self.to[*e]);
                    }
                }
            }
            if !reached[sink] {
                return;
            }
            let path: Vec<usize> = std::iter::successors(by[sink], |e| by[self.to[*e ^ 1]]).collect();
            let amount = path.iter().map(|e| self.room[*e]).min().unwrap_or(0);
            for e in path {
                self.room[e] -= amount;
                self.room[e ^ 1] = self.room[e ^ 1].saturating_add(amount);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Candidate, choose};

    fn candidate(id: u64, channels: u64, expensive: bool, operands: &[u64]) -> Candidate {
        Candidate { id, channels, expensive, operands: operands.to_vec() }
    }

    /// layer(3) -> series of many 2-channel values, all needed: the layer's 3 channels are stored.
    #[test]
    fn a_narrow_source_is_stored_once() {
        let all: Vec<Candidate> =
            std::iter::once(candidate(0, 3, true, &[])).chain((1..9).map(|i| candidate(i, 2, false, &[0]))).collect();
        assert_eq!(choose(&all, &[1, 2, 3, 4, 5, 6, 7, 8]), vec![0]);
    }

    /// layer(34) -> sum(2), needed: the sum is stored.
    #[test]
    fn a_narrow_result_is_stored_instead_of_its_wide_source() {
        let all = [candidate(0, 34, true, &[]), candidate(1, 34, false, &[0]), candidate(2, 2, false, &[1])];
        assert_eq!(choose(&all, &[2]), vec![2]);
    }

    #[test]
    fn what_is_cheap_from_inputs_is_not_stored() {
        let all = [candidate(0, 2, false, &[]), candidate(1, 2, false, &[0])];
        assert!(choose(&all, &[1]).is_empty());
    }
}
