//! Scratch places with lifetimes.

/// First-fit allocator over the scratch arena, in lanes; places are multiples of 16 lanes (a cache line).
#[derive(Default)]
pub(super) struct Arena {
    /// Free stretches, sorted: start, length.
    free: Vec<(usize, usize)>,
    end: usize,
}

impl Arena {
    pub fn take(&mut self, lanes: usize) -> usize {
        let lanes = lanes.next_multiple_of(16);
        if let Some(i) = self.free.iter().position(|f| f.1 >= lanes) {
            let (start, len) = self.free[i];
            if len == lanes {
                self.free.remove(i);
            } else {
                self.free[i] = (start + lanes, len - lanes);
            }
            return start;
        }
        // Grow the last stretch if it touches the end.
        if let Some(&(start, len)) = self.free.last()
            && start + len == self.end
        {
            self.free.pop();
            self.end = start + lanes;
            return start;
        }
        self.end += lanes;
        self.end - lanes
    }

    pub fn give(&mut self, start: usize, lanes: usize) {
        let lanes = lanes.next_multiple_of(16);
        let at = self.free.partition_point(|f| f.0 < start);
        self.free.insert(at, (start, lanes));
        if at + 1 < self.free.len() && self.free[at].0 + self.free[at].1 == self.free[at + 1].0 {
            self.free[at].1 += self.free[at + 1].1;
            self.free.remove(at + 1);
        }
        if at > 0 && self.free[at - 1].0 + self.free[at - 1].1 == self.free[at].0 {
            self.free[at - 1].1 += self.free[at].1;
            self.free.remove(at);
        }
    }

    /// Lanes the arena needs in all.
    pub fn len(&self) -> usize {
        self.end
    }
}

#[cfg(test)]
mod tests {
    use super::Arena;

    #[test]
    fn freed_places_merge_and_are_used_again() {
        let mut a = Arena::default();
        let (x, y, z) = (a.take(32), a.take(16), a.take(20));
        assert_eq!((x, y, z, a.len()), (0, 32, 48, 80));
        a.give(x, 32);
        a.give(y, 16);
        assert_eq!(a.take(48), 0);
        a.give(z, 20);
        assert_eq!(a.take(64), 48);
        assert_eq!(a.len(), 112);
    }
}
