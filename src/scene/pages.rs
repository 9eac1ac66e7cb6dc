//! Memory of chunks: pages of one cluster each, and a pool of pages that chunks have returned.
//!
//! Sections of a twin have 1 kB to 140 MB. If each is one block of the heap, sections that come and
//! go leave holes that the next ones do not fit into: 1,024 MiB of sections took 1,590 MiB of
//! memory. All pages of an SH degree have one size, so any page fits in the place of another. Only
//! the last page of a chunk may be smaller, so that a section of a few Gaussians takes no more than
//! it needs.

use std::collections::BTreeMap;
use std::sync::Arc;

use bytemuck::{Pod, Zeroable};
use parking_lot::Mutex;

/// Gaussians in a lane group: one AVX-512 register of f32, two of AVX2, four of SSE.
pub const LANES: usize = 16;
/// Gaussians in a cluster, the unit of frustum culling.
pub const CLUSTER: usize = 256;

/// One parameter of the 16 Gaussians of a lane group.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C, align(64))]
pub struct Lanes(pub [f32; LANES]);

/// Lane groups in a page.
pub(super) const PAGE_GROUPS: usize = CLUSTER / LANES;

/// The lane groups of a cluster.
pub(super) type Page = Vec<Lanes>;

/// Pages that chunks have returned, for the next ones.
#[derive(Debug)]
pub struct PagePool {
    limit_bytes: usize,
    free: Mutex<FreePages>,
}

#[derive(Debug, Default)]
struct FreePages {
    /// Empty pages by their capacity in lanes.
    pages: BTreeMap<usize, Vec<Page>>,
    bytes: usize,
}

impl PagePool {
    /// An empty pool that keeps at most `limit_bytes` of free pages.
    pub fn new(limit_bytes: usize) -> Self {
        Self { limit_bytes, free: Mutex::default() }
    }

    /// Bytes of free pages.
    pub fn free_bytes(&self) -> usize {
        self.free.lock().bytes
    }

    fn take(&self, lanes: usize) -> Option<Page> {
        // One lock for both fields, so that `bytes` is always that of `pages`.
        let free = &mut *self.free.lock();
        // `None` leaves the count as it is: nothing was taken.
        let page = free.pages.get_mut(&lanes)?.pop()?;
        free.bytes -= lanes * size_of::<Lanes>();
        Some(page)
    }

    /// Keeps whole pages of `lanes` lanes, as many as the limit permits; the caller drops the
    /// others.
    fn give_back(&self, lanes: usize, pages: &mut Vec<Page>) {
        let page_bytes = lanes * size_of::<Lanes>();
        let free = &mut *self.free.lock();
        let kept = free.pages.entry(lanes).or_default();
        // From the end, and only pages of the full capacity. What is left is freed by the caller,
        // after the lock is released.
        while free.bytes + page_bytes <= self.limit_bytes
            && let Some(mut page) = pages.pop_if(|page| page.capacity() == lanes)
        {
            page.clear();
            kept.push(page);
            free.bytes += page_bytes;
        }
    }
}

/// The lane groups of a chunk, in order. Dropped, it returns its pages to its pool.
#[derive(Debug)]
pub struct LanePages {
    /// Columns of a lane group.
    width: usize,
    /// Every page but the last is full.
    pages: Vec<Page>,
    groups: usize,
    /// Lane groups that are expected in all: the last page has no more capacity than these need.
    expected: usize,
    pool: Option<Arc<PagePool>>,
}

impl LanePages {
    /// No lane groups yet, of `width` columns each. Pages come from the pool, if there is one.
    pub fn new(width: usize, pool: Option<Arc<PagePool>>) -> Self {
        Self { width, pages: Vec::new(), groups: 0, expected: 0, pool }
    }

    /// Number of lane groups.
    pub fn len(&self) -> usize {
        self.groups
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.groups == 0
    }

    /// Columns of a lane group.
    pub(super) fn width(&self) -> usize {
        self.width
    }

    /// Announces lane groups, which are appended next. Their memory is allocated page by page.
    pub(super) fn expect(&mut self, groups: usize) {
        self.expected = self.groups + groups;
    }

    /// Appends whole lane groups.
    ///
    /// # Panics
    /// If the last one is not whole.
    pub fn extend_from_slice(&mut self, lanes: &[Lanes]) {
        assert!(lanes.len().is_multiple_of(self.width), "a part of a lane group");
        let mut rest = lanes;
        while !rest.is_empty() {
            // Room in the last page, which is a whole page if the last one is full.
            let room = (PAGE_GROUPS - self.groups % PAGE_GROUPS) * self.width;
            let (now, later) = rest.split_at(rest.len().min(room));
            self.last_page(now.len() / self.width).extend_from_slice(now);
            self.groups += now.len() / self.width;
            rest = later;
        }
    }

    /// Appends a lane group of zeros.
    pub(super) fn push_zeros(&mut self) {
        let width = self.width;
        let page = self.last_page(1);
        page.resize(page.len() + width, Lanes([0.0; LANES]));
        self.groups += 1;
    }

    /// The page of the next lane group, for `groups` of them.
    fn last_page(&mut self, groups: usize) -> &mut Page {
        if self.groups.is_multiple_of(PAGE_GROUPS) {
            let whole = PAGE_GROUPS * self.width;
            // At least what is about to be appended, also if more comes than was announced.
            let expected = self.expected.saturating_sub(self.groups).max(groups);
            // The rest of a chunk: exactly its size, from the heap, since pages in the pool are
            // whole.
            let page = if expected < PAGE_GROUPS {
                Page::with_capacity(expected * self.width)
            } else {
                let free = self.pool.as_ref().and_then(|pool| pool.take(whole));
                free.unwrap_or_else(|| Page::with_capacity(whole))
            };
            self.pages.push(page);
        }
        let last = self.pages.len() - 1;
        &mut self.pages[last]
    }

    /// The columns of one lane group.
    #[inline]
    pub(super) fn group(&self, group: usize) -> &[Lanes] {
        let first = group % PAGE_GROUPS * self.width;
        &self.pages[group / PAGE_GROUPS][first..first + self.width]
    }

    /// The columns of one lane group.
    pub(super) fn group_mut(&mut self, group: usize) -> &mut [Lanes] {
        let first = group % PAGE_GROUPS * self.width;
        &mut self.pages[group / PAGE_GROUPS][first..first + self.width]
    }

    /// The lane groups of each cluster, in order.
    pub(super) fn clusters_mut(&mut self) -> &mut [Page] {
        &mut self.pages
    }

    /// Memory that the pages and their list take, in bytes.
    pub(super) fn bytes(&self) -> usize {
        let page_bytes = |page: &Page| page.capacity() * size_of::<Lanes>() + size_of::<Page>();
        self.pages.iter().map(page_bytes).sum()
    }
}

impl Clone for LanePages {
    /// The clone's pages come from the heap.
    fn clone(&self) -> Self {
        // Without a pool: `Vec::clone` takes memory of the heap, which returns to the heap.
        Self { pages: self.pages.clone(), pool: None, ..*self }
    }
}

impl Drop for LanePages {
    fn drop(&mut self) {
        if let Some(pool) = &self.pool {
            let whole = PAGE_GROUPS * self.width;
            // The last one may be smaller.
            let mut whole_pages = std::mem::take(&mut self.pages);
            let smaller = whole_pages.pop_if(|page| page.capacity() != whole);
            pool.give_back(whole, &mut whole_pages);
            drop(smaller);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 23;
    const PAGE_BYTES: usize = PAGE_GROUPS * WIDTH * size_of::<Lanes>();

    fn lanes(groups: usize) -> Vec<Lanes> {
        (0..groups * WIDTH).map(|number| Lanes([number as f32; LANES])).collect()
    }

    fn pages(groups: usize, pool: &Arc<PagePool>) -> LanePages {
        let mut pages = LanePages::new(WIDTH, Some(pool.clone()));
        pages.expect(groups);
        pages.extend_from_slice(&lanes(groups));
        pages
    }

    #[test]
    fn groups_are_as_they_were_appended_and_take_what_they_need() {
        let pool = Arc::new(PagePool::new(usize::MAX));
        for groups in [0, 1, 15, 16, 17, 100] {
            let pages = pages(groups, &pool);
            assert_eq!(pages.len(), groups);
            let list_bytes = groups.div_ceil(PAGE_GROUPS) * size_of::<Page>();
            assert_eq!(pages.bytes(), groups * WIDTH * size_of::<Lanes>() + list_bytes);
            let expected = lanes(groups);
            for group in 0..groups {
                let own = &expected[group * WIDTH..(group + 1) * WIDTH];
                let equal = pages.group(group).iter().zip(own).all(|(a, b)| a.0 == b.0);
                assert!(equal && pages.group(group).len() == WIDTH, "{group} of {groups}");
            }
        }
    }

    #[test]
    fn whole_pages_return_to_the_pool_and_are_used_again_up_to_the_limit() {
        let pool = Arc::new(PagePool::new(3 * PAGE_BYTES));
        // Two whole pages, and one of four groups that goes back to the heap.
        drop(pages(36, &pool));
        assert_eq!(pool.free_bytes(), 2 * PAGE_BYTES);
        let again = pages(17, &pool);
        assert_eq!(pool.free_bytes(), PAGE_BYTES);
        assert_eq!(
            again.group(16)[0].0[0],
            (16 * WIDTH) as f32,
            "nothing is left of the old content"
        );
        // Pages of a different size do not fit.
        let mut other = LanePages::new(14, Some(pool.clone()));
        other.extend_from_slice(&vec![Lanes([0.0; LANES]); 16 * 14]);
        assert_eq!(pool.free_bytes(), PAGE_BYTES);
        drop((again, pages(64, &pool), other));
        assert!(pool.free_bytes() <= 3 * PAGE_BYTES && pool.free_bytes() >= 2 * PAGE_BYTES);
        let copy = pages(64, &pool).clone();
        let before = pool.free_bytes();
        drop(copy);
        assert_eq!(pool.free_bytes(), before, "a clone has pages of its own");
    }
}
