#pragma once

/**
 * Brightness of an image that covers the plane, summed up so that its mean over a triangle
 * is found without a look at each texel. Independent of variants.
 */

#include <array>
#include <cstddef>
#include <vector>

namespace manylights {

/// How an image goes on outside of the unit square
enum class Wrap { Repeat, Mirror, Clamp };

/// A point of the plane; the image fills the unit square
using Point2 = std::array<double, 2>;

class BrightnessMap {
public:
    /// `texels`: rows of finite numbers >= 0
    BrightnessMap(size_t width, size_t height, const std::vector<float> &texels,
                  Wrap wrap);

    /// Mean over the image
    float mean() const { return (float) (m_total * m_unit / m_width / m_height); }

    /**
     * Mean over a triangle or convex quadrilateral, which may cover any number of periods.
     * Approximate: it is cut into at most 32 rectangles, and a part of the mean over all texels
     * near its bounding box is mixed in, so that the result is positive if any texel is that a
     * lookup can reach. The mean over the image if a corner is not finite.
     */
    float mean(const Point2 *corners, size_t count) const;

    /// Where texel i of the next period along an axis of `size` texels comes from
    static size_t next_period(Wrap wrap, size_t i, size_t size);

private:
    struct Terms;
    struct Box {
        double low[2], high[2];
    };

    Terms terms(double x, size_t size) const;
    double sum_to(double x, double y) const;
    double integral(const Box &box) const;
    double mean_near(Box box) const;
    double mean_over_strips(const Point2 *corners, size_t count, const Box &box) const;

    size_t m_width, m_height;
    Wrap m_wrap;
    /// Sums over the texels before column x and row y: whole multiples of m_unit, exact
    std::vector<double> m_sums;
    double m_unit, m_total;
};

} // namespace manylights
