#include "brightness_map.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

namespace manylights {

/// Part of the mean over all texels near a polygon in that over the polygon
constexpr double kNearPart = 1. / 32;

/// An integral from 0 to x over the plane, as a sum of integrals within the image
struct BrightnessMap::Terms {
    double factor[3], x[3];
    int count = 0;
    void add(double f, double to) {
        if (f != 0) {
            factor[count] = f;
            x[count++]    = to;
        }
    }
};

BrightnessMap::BrightnessMap(size_t width, size_t height,
                             const std::vector<float> &texels, Wrap wrap)
    : m_width(width), m_height(height), m_wrap(wrap),
      m_sums((width + 1) * (height + 1), 0.) {
    // In whole units sums of up to 2^22 texels are exact, and what is black stays 0
    float largest = *std::max_element(texels.begin(), texels.end());
    m_unit        = largest > 0 ? largest / (double) (1 << 26) : 1;
    for (size_t y = 0; y < height; ++y) {
        double row = 0;
        for (size_t x = 0; x < width; ++x) {
            row += std::ceil(texels[y * width + x] / m_unit);
            m_sums[(y + 1) * (width + 1) + x + 1] = m_sums[y * (width + 1) + x + 1] + row;
        }
    }
    m_total = m_sums.back();
}

size_t BrightnessMap::next_period(Wrap wrap, size_t i, size_t size) {
    return wrap == Wrap::Repeat ? i : size - 1 - (wrap == Wrap::Mirror ? i : 0);
}

BrightnessMap::Terms BrightnessMap::terms(double x, size_t size) const {
    Terms result;
    double n = (double) size;
    if (m_wrap == Wrap::Clamp) {
        double inside = std::clamp(x, 0., n);
        result.add(1, inside);
        if (x < 0) {
            result.add(x, 1);
        } else if (x > n) {
            result.add(x - n, n);
            result.add(n - x, n - 1);
        }
        return result;
    }
    double period = std::floor(x / n), rest = std::clamp(x - period * n, 0., n);
    bool turned = m_wrap == Wrap::Mirror && std::fmod(period, 2) != 0;
    result.add(turned ? period + 1 : period, n);
    result.add(turned ? -1 : 1, turned ? n - rest : rest);
    return result;
}

/// Sum over the part of the image before (x, y)
double BrightnessMap::sum_to(double x, double y) const {
    size_t i = std::min((size_t) x, m_width - 1), j = std::min((size_t) y, m_height - 1);
    double fx = x - (double) i, fy = y - (double) j;
    const double *low = &m_sums[j * (m_width + 1) + i], *high = low + m_width + 1;
    return (1 - fy) * ((1 - fx) * low[0] + fx * low[1]) +
           fy * ((1 - fx) * high[0] + fx * high[1]);
}

double BrightnessMap::integral(const Box &box) const {
    auto to = [&](double x, double y) {
        Terms a = terms(x, m_width), b = terms(y, m_height);
        double sum = 0;
        for (int i = 0; i < a.count; ++i)
            for (int j = 0; j < b.count; ++j)
                sum += a.factor[i] * b.factor[j] * sum_to(a.x[i], b.x[j]);
        return sum;
    };
    return to(box.high[0], box.high[1]) - to(box.low[0], box.high[1]) -
           to(box.high[0], box.low[1]) + to(box.low[0], box.low[1]);
}

/// Mean over all texels that interpolation reaches from a box: exactly 0 if these are black
double BrightnessMap::mean_near(Box box) const {
    double area = 1;
    for (int axis = 0; axis < 2; ++axis) {
        double n = (double) (axis == 0 ? m_width : m_height), &low = box.low[axis],
               &high = box.high[axis];
        low          = std::floor(low) - 1;
        high         = std::ceil(high) + 1;
        if (m_wrap == Wrap::Clamp) {
            low  = std::clamp(low, -1., n);
            high = std::clamp(high, low + 1, n + 1);
        } else {
            high = std::min(high, low + 2 * n);
        }
        area *= high - low;
    }
    return integral(box) / area;
}

/// The interval that a convex polygon covers at height y
static std::pair<double, double> row_of_polygon(const Point2 *corners, size_t count,
                                                double y) {
    double low = std::numeric_limits<double>::max(), high = -low;
    for (size_t i = 0; i < count; ++i) {
        const Point2 &a = corners[i], &b = corners[(i + 1) % count];
        if (y < std::min(a[1], b[1]) || y > std::max(a[1], b[1]))
            continue;
        // Of an edge along the row, all
        double t = a[1] != b[1] ? (y - a[1]) / (b[1] - a[1]) : 0,
               p = a[0] + t * (b[0] - a[0]), q = a[1] != b[1] ? p : b[0];
        low  = std::min({ low, p, q });
        high = std::max({ high, p, q });
    }
    return { low, high };
}

double BrightnessMap::mean_over_strips(const Point2 *corners, size_t count,
                                       const Box &box) const {
    double height         = box.high[1] - box.low[1],
           extent         = std::max(box.high[0] - box.low[0], height);
    constexpr double most = 32, thinnest = .01; // what has no extent is a lookup
    bool aligned  = count == 4 &&
                    (corners[0][0] == corners[1][0] || corners[0][1] == corners[1][1]) &&
                    (corners[1][0] == corners[2][0] || corners[1][1] == corners[2][1]);
    size_t strips = aligned ? 1 : (size_t) std::clamp(std::ceil(extent), 4., most);
    double half   = .5 * std::max(height / (double) strips, thinnest);
    double sum = 0, area = 0;
    for (size_t k = 0; k < strips; ++k) {
        double y         = box.low[1] + height * ((double) k + .5) / (double) strips;
        auto [low, high] = row_of_polygon(corners, count, y);
        double center = .5 * (low + high), width = std::max(high - low, thinnest);
        sum += integral(
            { { center - .5 * width, y - half }, { center + .5 * width, y + half } });
        area += width * 2 * half;
    }
    return std::max(sum, 0.) / area;
}

float BrightnessMap::mean(const Point2 *polygon, size_t count) const {
    constexpr double largest = 1e9;
    Point2 corners[4];
    Box box;
    for (int axis = 0; axis < 2; ++axis) {
        double size = (double) (axis == 0 ? m_width : m_height), low = polygon[0][axis];
        for (size_t i = 0; i < count; ++i) {
            if (!(std::abs(polygon[i][axis]) * size < largest)) // NaN, too
                return mean();
            low = std::min(low, polygon[i][axis]);
        }
        // Two periods of a mirrored image are one
        double shift   = m_wrap == Wrap::Clamp ? 0 : 2 * std::floor(low / 2);
        box.low[axis]  = largest;
        box.high[axis] = -largest;
        for (size_t i = 0; i < count; ++i) {
            double x         = (polygon[i][axis] - shift) * size;
            corners[i][axis] = x;
            box.low[axis]    = std::min(box.low[axis], x);
            box.high[axis]   = std::max(box.high[axis], x);
        }
    }
    double near = mean_near(box);
    if (!(near > 0))
        return 0;
    double inside = mean_over_strips(corners, count, box);
    return (float) (m_unit * ((1 - kNearPart) * inside + kNearPart * near));
}

} // namespace manylights
