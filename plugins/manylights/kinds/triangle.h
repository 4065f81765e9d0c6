#pragma once

#include "light_bounds.h"
#include "light_geometry.h"
#include <mitsuba/core/warp.h>

namespace manylights {

/**
 * A triangle of an emissive mesh, sampled uniformly by area. Its row: vertex[3], edge1[3],
 * edge2[3]; it emits to the side of edge1 x edge2. One with smooth normals is sampled on both
 * sides (kTagTwoSided), since the side on which it emits changes from point to point.
 */
struct TriangleLight {
    static constexpr LightKind kind = LightKind::Triangle;
    static constexpr bool is_delta  = false;
    static constexpr bool has_beam  = true;

    /// The side of a triangle, by its winding, on which it emits: that of the shading normal
    enum class Side { Front, Back, Both };

    /// Read face `index` of a mesh; `face`: its three vertices
    static void read(const float *vertices, const uint32_t *face, uint32_t index,
                     Side side, Emission e, LightRow &row, LightBounds &bounds) {
        // With smooth normals only the emitter knows where it emits
        e.tabulated &= side != Side::Both;
        bool flip       = side == Side::Back;
        row             = make_row(kind, e);
        const float *v0 = vertices + 3 * (size_t) face[0],
                    *v1 = vertices + 3 * (size_t) face[flip ? 2 : 1],
                    *v2 = vertices + 3 * (size_t) face[flip ? 1 : 2];
        double square   = 0;
        for (int i = 0; i < 3; ++i) {
            row.geometry[i]     = v0[i];
            row.geometry[3 + i] = v1[i] - v0[i];
            row.geometry[6 + i] = v2[i] - v0[i];
            bounds.box_min[i]   = std::min({ v0[i], v1[i], v2[i] });
            bounds.box_max[i]   = std::max({ v0[i], v1[i], v2[i] });
            double mean         = ((double) v0[i] + v1[i] + v2[i]) / 3;
            bounds.mean[i]      = (float) mean;
            square += (v0[i] - mean) * (v0[i] - mean) + (v1[i] - mean) * (v1[i] - mean) +
                      (v2[i] - mean) * (v2[i] - mean);
        }
        bounds.variance = (float) (square / 36); // of a uniform point; trace / 3
        set_axis(bounds, row.geometry + 3, row.geometry + 6);
        if (side == Side::Both) {
            row.tag |= kTagTwoSided;
            std::fill_n(bounds.axis, 3, 0.f);
        }
        if (!e.tabulated)
            set_primitive(row, index, flip);
    }

    /// `normals`: of the vertices, null if the mesh is faceted
    static Side emitting_side(const float *vertices, const float *normals,
                              const uint32_t *face) {
        if (!normals)
            return Side::Front;
        auto corner = [&](const float *buffer, int i) {
            const float *v = buffer + 3 * (size_t) face[i];
            return mitsuba::Vector<float, 3>(v[0], v[1], v[2]);
        };
        auto v0 = corner(vertices, 0);
        auto n =
            dr::normalize(dr::cross(corner(vertices, 1) - v0, corner(vertices, 2) - v0));
        float low = 1, high = -1;
        for (int i = 0; i < 3; ++i) {
            float cosine = dr::dot(n, dr::normalize(corner(normals, i)));
            low          = std::min(low, cosine);
            high         = std::max(high, cosine);
        }
        constexpr float flat = .999999f; // a tenth of a degree
        return low > flat ? Side::Front : (high < -flat ? Side::Back : Side::Both);
    }

    static double power(const LightRow &row) {
        double brightness = row.brightness;
        return edge_area(row.geometry + 3, row.geometry + 6) * .5f * kPi * brightness;
    }

    static float diameter(const LightRow &row) {
        const float *u = row.geometry + 3, *v = row.geometry + 6;
        return std::max(
            { norm(u), norm(v), norm(u[0] - v[0], u[1] - v[1], u[2] - v[2]) });
    }

    template <typename Float> static Beam<Float> beam(const Row<Float> &row) {
        return flat_beam(row, row.two_sided());
    }

    template <typename Float>
    static Appearance<Float> appearance(const Row<Float> &row,
                                        const typename Row<Float>::Point3f &x,
                                        float least) {
        using Vector3f = mitsuba::Vector<Float, 3>;
        Vector3f e1 = row.vector(3), e2 = row.vector(6), a = .5f * dr::cross(e1, e2),
                 w  = row.vector(0) - x + (e1 + e2) * (1.f / 3.f);
        Float front = flat_intensity<Float>(a, w), back = flat_intensity<Float>(-a, w);
        // Edge-on to a smooth triangle some normals may still face x: leave a floor
        Float both = max_of(front + back, .05f * dr::norm(a));
        front      = max_of(front, least * dr::norm(a));
        return { w, .16f * dr::norm(a), dr::select(row.two_sided(), both, front) };
    }

    template <typename Float>
    static LightPoint<Float> sample(const Row<Float> &row,
                                    const typename Row<Float>::Point3f &x,
                                    const typename Row<Float>::Point2f &u) {
        return flat_point<Float>(row, x, mitsuba::warp::square_to_uniform_triangle(u),
                                 .5f, row.two_sided());
    }

    template <typename Float>
    static mitsuba::Vector<Float, 3> normal(const Row<Float> &row,
                                            const typename Row<Float>::Point3f &) {
        return flat_normal(row);
    }

    template <typename Float>
    static Float pdf(const Row<Float> &row, const typename Row<Float>::Point3f &x,
                     const typename Row<Float>::Point3f &p,
                     const typename Row<Float>::Vector3f &) {
        return flat_pdf<Float>(row, .5f, p - x, row.two_sided());
    }
};

} // namespace manylights
