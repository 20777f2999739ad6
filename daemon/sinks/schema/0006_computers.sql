-- Which computer `delivered` last, by a number made of its network cards: a copied disk has the same store on another one.
ALTER TABLE deliveries ADD COLUMN computer text NOT NULL DEFAULT '';
