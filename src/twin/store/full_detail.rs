//! Reading a version's Gaussians at full detail, section by section.

use wildcity_scene::Gaussians;
use wildcity_scene::geometry::Bounds;

use super::{Catalog, StoreError, Version};

impl Catalog {
    /// Shows `visit` the Gaussians of each section at full detail whose 3-sigma bounds `is_wanted`,
    /// in world axes. Only one section is in memory at a time.
    ///
    /// # Errors
    /// As [`Catalog::section`].
    pub fn visit_full_detail(
        &self,
        version: &Version,
        is_wanted: &dyn Fn(&Bounds) -> bool,
        visit: &mut dyn FnMut(Gaussians),
    ) -> Result<(), StoreError> {
        for chunk in version.manifest.chunks.iter().filter(|chunk| is_wanted(&chunk.bounds)) {
            for section in chunk.full_detail() {
                if is_wanted(&chunk.section_bounds(section)) {
                    visit(self.section(version, chunk, section)?.to_gaussians());
                }
            }
        }
        Ok(())
    }
}
