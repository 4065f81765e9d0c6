#pragma once

/**
 * The flat light table: one row of 64 bytes for every light that can be sampled.
 *
 * A *light* is the unit of selection: a point, a spot, one triangle of an emissive
 * mesh, a sphere, a disk, a cylinder, or any other emitter of finite extent as a
 * whole. Rows are filled once for each scene (light_table.h), put into the order of
 * the tree's leaves (tree_builder.h) and read by the kernels as 16 consecutive floats
 * (row.h), without a virtual call.
 *
 * Plain C++, no Dr.Jit and no Mitsuba types: compiled once for all variants.
 */

#include <cstddef>
#include <cstdint>
#include <vector>

namespace manylights {

/// How the geometry of a row is to be read; each kind is a file beside this one (kinds.h).
/// Their order has no meaning.
enum class LightKind : uint32_t { Point, Spot, Triangle, Sphere, Disk, Cylinder, Other };

/// Marks "no light", "no node" and "not a primitive of a light"
constexpr uint32_t kNone = 0xffffffffu;
/// A primitive that emits but cannot be sampled: rays that hit it see its emission
constexpr uint32_t kOnlyHit = 0xfffffffeu;

/**
 * One row of the table; what its geometry means is said by its kind.
 *
 * Radiance (areas) or intensity (points and spots) is `color` in RGB and monochrome
 * variants; in spectral ones it is scale * D65(lambda) * S(color, lambda), with S
 * Mitsuba's sigmoid upsampling of the coefficients `color`. A row that is not
 * `tabulated` has its emission evaluated by its emitter; `color[0]` then holds the bits
 * of the triangle's index (0 for other shapes) and `color[1]` is 1 if its two edges, or the
 * axes of a disk, were swapped to make it emit to the right side, 0 if not.
 */
struct LightRow {
    float geometry[9];
    float color[3];
    /// Brightness of the mean radiance or intensity; for `Other`: flux / (4 pi)
    float brightness;
    /// See above; 1 in RGB and monochrome variants
    float scale;
    /// Kind, flags and the index into the scene's emitters, see kTagKindMask
    uint32_t tag;
    /// 4 * parent node + slot of this light in the parent (tree_builder.h)
    uint32_t link;
};

constexpr size_t kRowFloats = 16;
static_assert(sizeof(LightRow) == kRowFloats * sizeof(float));

/// Offsets of the fields of a row, in floats
enum RowField : size_t {
    kColor      = 9,
    kBrightness = 12,
    kScale      = 13,
    kTag        = 14,
    kLink       = 15
};

constexpr uint32_t kTagKindMask     = 7;
constexpr uint32_t kTagTabulated    = 8;
constexpr uint32_t kTagTwoSided     = 16;
constexpr uint32_t kTagEmitterShift = 5;
/// How many kinds the tag has room for
constexpr uint32_t kMostKinds = kTagKindMask + 1;

inline LightKind kind_of(const LightRow &row) {
    return (LightKind) (row.tag & kTagKindMask);
}

/**
 * What the tree has to know of a light (estimator: moments and mean emission axis).
 *
 * `flux` is the weight of the light in the tree: the emitted power.
 *
 * Where all spots are wide, their lobes are taken for cosines, and they get the weight
 * sqrt(power * 4 pi * peak intensity): such a beam matters more than its power where it
 * falls, and less elsewhere. Narrow ones have lobes of their own (\ref Directions).
 *
 * One cache line of four SIMD registers: the builder sorts these in place.
 */
struct alignas(64) LightBounds {
    float box_min[3], flux;
    float box_max[3];
    /// Index of the light in the builder's input
    uint32_t light;
    /// Mean position and its variance (trace of the covariance / 3)
    float mean[3], variance;
    /// Emission axis, 0 for what shines in all directions: a unit vector for one-sided
    /// planar emitters and spots. With narrow spots in the scene, the mean direction of
    /// emission, whose length is the mean cosine
    float axis[3];
    /// For the builder: the weight of the axis
    float weight;
};

} // namespace manylights
