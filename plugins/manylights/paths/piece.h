#pragma once

/**
 * Pieces of paths in media: free flights, and segments of homogeneous media whose single
 * scattering is estimated as a whole.
 */

#include "manylights/scene/media.h"
#include "path_state.h"

namespace manylights {

/// What became of a piece of the path
template <typename Float, typename Spectrum> struct Piece {
    MI_IMPORT_TYPES()
    using FloatD   = dr::detached_t<Float>;
    using InMedium = manylights::InMedium<Float, Spectrum>;

    /// The medium, where the path is in one; `here` if its vertex is a point in it
    InMedium inside;
    /// Was it scattered before it reached the surface?
    Mask scattered = false;
    /// Is single scattering estimated along all of it? Factor of the light of its vertex
    Mask segment             = false;
    UnpolarizedSpectrum seen = 1.f;
    /// Factor of the path that goes on
    UnpolarizedSpectrum weight = 1.f;
    /// Does it end on an emitter that the camera does not see, but what is behind it?
    Mask hidden = false;
    /// The segment as the tree sees it, and its random number
    Receiver<FloatD> along;
    Float u_tree;
};

/// Moves paths through the media of a scene
template <typename Float, typename Spectrum> class Flights {
public:
    MI_IMPORT_TYPES()
    using Media    = manylights::Media<Float, Spectrum>;
    using State    = PathState<Float, Spectrum>;
    using Piece    = manylights::Piece<Float, Spectrum>;
    using InMedium = typename Piece::InMedium;
    using FloatD   = typename Piece::FloatD;

    /// @param segments  is single scattering estimated along whole segments?
    Flights(const Media &media, const PathLimits &limits, bool segments)
        : m_media(media), m_limits(limits), m_homogeneous(media.kinds().homogeneous),
          m_segments(segments) {}

    /// Move through the medium that the path is in
    MI_NOINLINE void fly(State &s, Piece &piece) const {
        InMedium &inside = piece.inside;
        inside      = { s.medium, dr::zeros<MediumInteraction3f>(), false, s.ray.o, 0.f };
        piece.along = dr::zeros<Receiver<FloatD>>();
        piece.u_tree = 0.f;
        Mask within  = s.active && s.medium != nullptr;
        if (dr::any_or<true>(within)) {
            auto flight =
                m_media.fly(s.medium, s.ray, s.pi.t, s.densities, s.sampler, within);
            inside.mei      = flight.mei;
            piece.scattered = within && flight.scattered && !m_limits.is_last(s.depth);
            piece.weight    = dr::select(within, flight.weight, 1.f);
            Mask exact      = within && passes_exactly(s, within);
            if (m_media.kinds().chromatic)
                dr::masked(s.densities, within && !exact) = flight.densities;
            s.active &= !(flight.scattered && within) || piece.scattered || exact;
            s.valid |= piece.scattered;
            s.ended |= exact && flight.scattered && m_limits.is_last(s.depth);
            if (m_homogeneous)
                take_exact(s, piece, exact);
            piece.seen = piece.weight;
            if (m_segments)
                find_segment(s, piece, within);
            inside.here = piece.scattered && !piece.segment;
        }
        inside.mei.time        = s.ray.time;
        inside.mei.wavelengths = s.ray.wavelengths;
    }

private:
    /// Where nothing that is scattered counts, what goes on has the known transmittance, and
    /// not that of a flight which may end
    Mask passes_exactly(const State &s, Mask within) const {
        if (!m_homogeneous || (m_segments && m_limits.max_depth == kUnlimited))
            return false;
        Mask exact = within && s.medium->is_homogeneous();
        return m_segments ? Mask(exact && m_limits.is_last(s.depth)) : exact;
    }

    void take_exact(const State &s, Piece &piece, Mask exact) const {
        piece.scattered &= !exact;
        dr::masked(piece.weight, exact) = Media::transmittance(piece.inside.mei, s.pi.t);
    }

    /// Is this a piece whose single scattering is estimated as a whole?
    void find_segment(const State &s, Piece &piece, Mask within) const {
        piece.segment = within && s.medium->is_homogeneous() &&
                        s.medium->use_emitter_sampling() && !m_limits.is_last(s.depth) &&
                        s.pi.t > 0.f;
        dr::masked(piece.seen, piece.segment) =
            Media::transmittance(piece.inside.mei, s.pi.t);
    }

    const Media &m_media;
    const PathLimits &m_limits;
    bool m_homogeneous, m_segments;
};

} // namespace manylights
